"""Draw docs/pictures/source-*.png, one scene of each source: `PYTHONPATH=. python docs/scene_sources.py [NAME …]`.

Sources whose data cannot be shipped are drawn from the tiny buildings of the tests; `sweethome3d_furniture` from the
furniture where it was fetched.
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


def draw(name: str, made: SceneSource, folder: Path) -> None:
    """A scene's map with its objects' names, and the view that shows most of chairs, beds and tables."""
    scene = made.load(made.scenes("train")[0])
    renderer = renderer_of(scene)
    config = configured(folder, "ground_truth.resolution=0.04", "ground_truth.camera.width=96")
    table, spec = instantiate(config.data.table), instantiate(config.ground_truth)
    truth = build(scene, renderer, spec, table)
    lookup = scene.category_of_instance(table.names)
    looks = []
    for pose in sample_poses(scene.free_space, 80, np.random.default_rng(1)):
        image = renderer.render(CAMERA, CAMERA.to_world(pose, scene.floor_height))
        shown = lookup[np.maximum(image.instance, 0)]
        amount = sum(np.sqrt((shown == index).mean()) for index in range(1, len(table) + 1))
        looks.append((amount, len(looks), image))
    image = max(looks)[2]
    figure = Figure(figsize=(10.0, 3.9), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.5, 1.0, 1.0))
    visualization.show_truth(left, scene, truth, table)
    middle.imshow(image.rgb)
    right.imshow(np.where(image.depth > 0, image.depth, np.nan), cmap="viridis_r")
    for axes, title in ((left, f"{made.name}: {scene.name}"), (middle, "colour"), (right, "depth")):
        axes.set_title(title, fontsize=9)
    for axes in (middle, right):
        axes.set_axis_off()
    figure.savefig(PICTURES / f"source-{name}.png")
    print(PICTURES / f"source-{name}.png")


def main(names: list[str]) -> None:
    """Draw the sources named, or all."""
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
