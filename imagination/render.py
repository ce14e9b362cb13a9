"""Ground truth of a scene as arrays and pictures: `python -m imagination.render scene=test_0000`."""

import logging
import re
import sys
from pathlib import Path
from typing import cast

import numpy as np
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig

from imagination.geometry.morphology import kernel_cells
from imagination.ground_truth import visualization
from imagination.reporting.scene_summary import Kernels, choose_views, stack, summary
from imagination.runs.command import command
from imagination.runs.logging import logging_to
from imagination.scenes.source import SPLITS, Split
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import check_choice, check_range
from imagination.views.observer import Observer

log = logging.getLogger(__name__)


@command("render")
def main(config: DictConfig) -> None:
    """Write the ground truth and some views of one scene."""
    check_range("poses", config.poses, 1, 10_000, "views")
    observer: Observer = instantiate(config.data.observer)
    split = cast(Split, check_choice("split", config.split, SPLITS))
    name = config.scene or observer.source.scenes(split)[0]
    folder = Path(config.folder) / folder_name(name)
    try:
        draw(config, observer, name, folder)
    except KeyboardInterrupt:
        print(f"Interrupted; not all files of {folder}/ are written. Start again.", file=sys.stderr)
        sys.exit(130)


def folder_name(scene: str) -> str:
    """One folder's name for a scene whose name may be a path, as a file of Habitat's is."""
    return re.sub(r"[^\w.-]+", "_", scene).strip("._")


def draw(config: DictConfig, observer: Observer, name: str, folder: Path) -> None:
    """Write everything about one scene."""
    scene, truth = observer.scene(name), observer.truth(name)
    folder.mkdir(parents=True, exist_ok=True)
    with logging_to(folder / "render.log"):
        for line in summary(scene, truth, observer.categories):
            log.info(line)
        sizes = config.kernels.imaginable, config.kernels.neighbourhood
        kernels = Kernels(*(kernel_cells(size, observer.ego.resolution) for size in sizes))
        views = choose_views(observer, name, config.poses, config.seed, kernels)
        save_arrays(
            folder / "truth.npz", {**truth.to_arrays(), "categories": np.array(observer.categories.names)}
        )
        save_arrays(folder / "views.npz", stack(views))
        save_figure(folder / "scene.png", visualization.draw_scene(scene, truth, observer.categories, views))
        for category in observer.categories.names:
            save_figure(
                folder / f"{category}.png",
                visualization.draw_category(scene, truth, observer.categories, category),
            )
        save_figure(folder / "views.png", visualization.draw_views(views, observer.ego))
        save_figure(
            folder / "labels.png", visualization.draw_labels(views, observer.ego, observer.categories)
        )
        log.info("Written: %s/ (truth.npz, views.npz and pictures)", folder)


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays whole or not at all."""
    with replacing(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]


def save_figure(path: Path, figure: Figure) -> None:
    """Write a picture whole or not at all."""
    with replacing(path) as temporary:
        figure.savefig(temporary)


if __name__ == "__main__":
    main()
