"""What an evaluation finds: counts of every run, what was chosen on validation scenes, and examples to draw."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from imagination.evaluation.threshold_selection import SelectedThreshold
from imagination.evaluation.trials import Trial
from imagination.geometry.grid import Grid
from imagination.utils.atomic_io import write_text
from imagination.utils.tabular import to_csv

SCENES = "scenes.csv"
"""In tables/: the scenes to measure; which of them are missing is seen where an evaluation stopped."""

SelectedThresholds = dict[tuple[str, str], SelectedThreshold]
"""What was chosen for each approach and category."""


class Key(NamedTuple):
    """A row of the table."""

    approach: str
    category: str
    cell_width: float


Counts = dict[Key, Int64[np.ndarray, "scenes sets 3"]]
"""Correct, false and truth pixels of every run of the scenes that contain the category."""


class Example(NamedTuple):
    """Maps of one run, for figures.

    Attributes:
        run, category: which.
        grid: of the maps.
        occupied, truth: M_occu and M_gt.
        predicted: the map of each approach.
        poses: of the views.
    """

    trial: Trial
    category: str
    grid: Grid
    occupied: Bool[np.ndarray, "h w"]
    truth: Bool[np.ndarray, "h w"]
    predicted: dict[str, Bool[np.ndarray, "h w"]]
    poses: Float64[np.ndarray, "n 3"]


class Report(NamedTuple):
    """What was measured.

    Attributes:
        counts: of whole maps.
        shuffled: the same with the views of each run registered in a random order.
        choices: threshold and kernel of each approach and category.
        scenes, left_out: for each category, the scenes that contain it and those that do not.
        examples: maps of the first viewpoint set of each category's first scene, one for each cell width.
        snap_distances: how far each viewpoint of each run was moved to free space, metres.
        seen: counts in the cells alone that a view of the run saw.
        first_person: IoU of the predicted segmentation of the runs' images, pooled over them, for each category; empty
            without a segmentation network.
    """

    counts: Counts
    shuffled: Counts
    choices: SelectedThresholds
    scenes: dict[str, list[str]]
    left_out: dict[str, list[str]]
    examples: list[Example]
    snap_distances: list[Float64[np.ndarray, " n"]]
    seen: Counts
    first_person: dict[str, float]


def write_scenes(folder: Path, scenes: Sequence[str]) -> None:
    """Write the names of the scenes that will be measured."""
    write_text(folder / SCENES, to_csv([{"scene": scene} for scene in scenes]))
