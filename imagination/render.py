"""Write the ground truth and views of a scene as arrays and images: `python -m imagination.render scene=test_0000`."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, cast

from hydra.utils import instantiate
from omegaconf import DictConfig

from imagination.runs.command import command
from imagination.runs.logging import logging_to
from imagination.scenes.source import SPLITS, Split
from imagination.utils import interrupts
from imagination.utils.atomic_io import replacing, write_npz
from imagination.utils.errors import check_choice, check_range
from imagination.utils.file_names import file_name

if TYPE_CHECKING:  # imports matplotlib and numba, which --help does not need
    from matplotlib.figure import Figure

    from imagination.views.observer import Observer

log = logging.getLogger(__name__)


@command("render")
def main(config: DictConfig) -> None:
    """Write the ground truth and a sample of views of one scene."""
    check_range("poses", config.poses, 1, 10_000, "views")
    observer: Observer = instantiate(config.data.observer)
    split = cast(Split, check_choice("split", config.split, SPLITS))
    name = config.scene or observer.source.scenes(split)[0]
    folder = Path(config.folder) / file_name(name)
    try:
        write_scene(config, observer, name, folder)
    except KeyboardInterrupt:
        print(f"Interrupted; {folder}/ is incomplete. Run the same command again.", file=sys.stderr)
        sys.exit(interrupts.exit_code())


def write_scene(config: DictConfig, observer: Observer, name: str, folder: Path) -> None:
    """Write arrays, images and a summary of one scene."""
    import numpy as np

    from imagination.geometry.morphology import kernel_cells
    from imagination.ground_truth import visualization
    from imagination.reporting.scene_summary import Kernels, choose_views, stack, summary

    scene, gt = observer.scene(name), observer.ground_truth(name)
    folder.mkdir(parents=True, exist_ok=True)
    with logging_to(folder / "render.log"):
        for line in summary(scene, gt, observer.categories):
            log.info(line)
        sides = config.kernels.imaginable, config.kernels.neighbourhood
        kernels = Kernels(*(kernel_cells(side, observer.ego.resolution) for side in sides))
        views = choose_views(observer, name, config.poses, config.seed, kernels)
        write_npz(folder / "truth.npz", {**gt.to_arrays(), "categories": np.array(observer.categories.names)})
        write_npz(folder / "views.npz", stack(views))
        save_figure(folder / "scene.png", visualization.draw_scene(scene, gt, observer.categories, views))
        for category in observer.categories.names:
            save_figure(
                folder / f"{category}.png",
                visualization.draw_category(scene, gt, observer.categories, category),
            )
        save_figure(folder / "views.png", visualization.draw_views(views, observer.ego))
        save_figure(
            folder / "labels.png", visualization.draw_labels(views, observer.ego, observer.categories)
        )
        log.info("Written: %s/ (truth.npz, views.npz and images)", folder)


def save_figure(path: Path, figure: Figure) -> None:
    """Write a figure atomically."""
    with replacing(path) as temporary:
        figure.savefig(temporary)


if __name__ == "__main__":
    main()
