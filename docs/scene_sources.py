"""Draw docs/pictures/source-*.png, one scene of each source: `PYTHONPATH=. python docs/scene_sources.py [NAME …]`.

Sources whose data cannot be shipped are drawn from the tiny buildings of the tests. `sweethome3d_furniture` needs the
downloaded furniture (`python -m imagination.assets name=sweethome3d`).
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from imagination.geometry.camera import Camera
from imagination.ground_truth import visualization
from imagination.ground_truth.scene_maps import build
from imagination.scenes.renderer import renderer_of
from imagination.scenes.source import SceneSource
from imagination.views.pose_samplers import sample_poses
from tests.helpers.fake_habitat import install
from tests.helpers.scene_sources import NEEDS, SOURCES, configured, source

PICTURES = Path(__file__).parent / "pictures"
CAMERA = Camera.from_degrees(384, 288, 80.0, 1.25, pitch=8.0)


def draw(name: str, scene_source: SceneSource, folder: Path) -> None:
    """Draw the map of a scene with the names of its objects, and the view with the most chairs, beds and tables."""
    scene = scene_source.load(scene_source.scenes("train")[0])
    renderer = renderer_of(scene)
    config = configured(folder, "ground_truth.resolution=0.04", "ground_truth.camera.width=96")
    table, spec = instantiate(config.data.table), instantiate(config.ground_truth)
    ground_truth = build(scene, renderer, spec, table)
    lookup = scene.category_of_instance(table.names)
    views = []
    for pose in sample_poses(scene.free_space, 80, np.random.default_rng(1)):
        image = renderer.render(CAMERA, CAMERA.to_world(pose, scene.floor_height))
        categories = lookup[np.maximum(image.instance, 0)]
        score = sum(np.sqrt((categories == index).mean()) for index in range(1, len(table) + 1))
        views.append((score, len(views), image))
    image = max(views)[2]
    figure = Figure(figsize=(10.0, 3.9), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.5, 1.0, 1.0))
    visualization.show_ground_truth(left, scene, ground_truth, table)
    middle.imshow(image.rgb)
    right.imshow(np.where(image.depth > 0, image.depth, np.nan), cmap="viridis_r")
    for axes, title in ((left, f"{scene_source.name}: {scene.name}"), (middle, "colour"), (right, "depth")):
        axes.set_title(title, fontsize=9)
    for axes in (middle, right):
        axes.set_axis_off()
    figure.savefig(PICTURES / f"source-{name}.png")
    print(PICTURES / f"source-{name}.png")


def main(names: list[str]) -> None:
    """Draw the given sources, or all of them."""
    for name in names or [name for name in SOURCES if name not in NEEDS]:
        with tempfile.TemporaryDirectory() as scratch, pytest.MonkeyPatch.context() as patch:
            folder = Path(scratch)
            if name == "habitat":
                install(patch)
            if name == "sweethome3d_furniture":
                draw(name, source(folder, "data/furniture=sweethome3d"), folder)
            else:
                draw(name, SOURCES[name](folder), folder)


if __name__ == "__main__":
    main(sys.argv[1:])
