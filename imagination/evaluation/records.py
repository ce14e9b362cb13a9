"""Records of an evaluation: counts of every trial, thresholds selected on validation scenes, and example maps."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from imagination.evaluation.threshold_selection import SelectedThreshold
from imagination.evaluation.trials import Trial
from imagination.geometry.grid import Grid

SelectedThresholds = dict[tuple[str, str], SelectedThreshold]
"""Selected threshold and kernel by approach and category."""


class Key(NamedTuple):
    """Key of a row of the results table."""

    approach: str
    category: str
    cell_width: float


Counts = dict[Key, Int64[np.ndarray, "scenes sets 3"]]
"""Correct, false-positive and ground-truth pixels of every trial in the scenes that contain the category."""


class Example(NamedTuple):
    """Maps of one trial and category, for figures.

    Attributes:
        trial: viewpoint set of a scene.
        category: name of the category.
        grid: grid of the maps.
        occupied: occupancy map M_occu.
        truth: ground-truth map M_gt.
        predicted: predicted map by approach.
        poses: poses of the views (x, y in metres, heading in radians).
    """

    trial: Trial
    category: str
    grid: Grid
    occupied: Bool[np.ndarray, "h w"]
    truth: Bool[np.ndarray, "h w"]
    predicted: dict[str, Bool[np.ndarray, "h w"]]
    poses: Float64[np.ndarray, "n 3"]


class Report(NamedTuple):
    """Results of an evaluation on one set of scenes.

    Attributes:
        counts: counts over whole maps.
        shuffled: counts over whole maps with the views of each trial registered in a random order.
        selected: selected threshold and kernel by approach and category.
        scenes: names of the scenes that contain each category.
        left_out: names of the scenes that do not contain each category.
        examples: maps of the first viewpoint set of each category's first scene, one for each cell width.
        snap_distances: distance from each viewpoint of each trial to its free cell, metres.
        seen: counts over the cells that at least one view of the trial saw.
        first_person: IoU of the predicted first-person segmentation by category, pooled over all images; empty without
            a segmentation network.
    """

    counts: Counts
    shuffled: Counts
    selected: SelectedThresholds
    scenes: dict[str, list[str]]
    left_out: dict[str, list[str]]
    examples: list[Example]
    snap_distances: list[Float64[np.ndarray, " n"]]
    seen: Counts
    first_person: dict[str, float]
