"""Choosing an approach's threshold and kernel on validation scenes, by pooled IoU over all runs and cell widths."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from imagination.evaluation.metrics import iou

THRESHOLDS: Float32[np.ndarray, " t"] = (np.arange(1, 100) / 100).astype(np.float32)
"""Candidates; above 0, so that a cell which no view wrote is never part of a map."""


class SelectedThreshold(NamedTuple):
    """What was chosen for one approach and category.

    Attributes:
        threshold: cells with at least this score form the map.
        kernel: of closing or growing, metres; 0 where the approach does neither.
        iou: pooled over the validation scenes.
    """

    threshold: float
    kernel: float
    iou: float


def reached(
    score: Float32[np.ndarray, "*shape"], thresholds: Float32[np.ndarray, " t"]
) -> Int64[np.ndarray, "*shape"]:
    """How many of the thresholds, ascending, each cell reaches: one that equals its score too."""
    return np.searchsorted(thresholds, score, side="right")


def confusion_counts(
    score: Float32[np.ndarray, "h w"], truth: Bool[np.ndarray, "h w"], thresholds: Float32[np.ndarray, " t"]
) -> Int64[np.ndarray, "t 3"]:
    """Correct, false and truth pixels of [score >= threshold] for each threshold, in one pass over the map.

    Args:
        score: of each cell.
        truth: the map to compare with.
        thresholds: ascending.
    """
    considered = score >= thresholds[0]
    bins = reached(score[considered], thresholds) - 1  # the highest one
    hits = truth[considered]

    def at_least(chosen: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " t"]:
        return np.bincount(chosen, minlength=len(thresholds))[::-1].cumsum()[::-1]

    correct, false = at_least(bins[hits]), at_least(bins[~hits])
    return np.stack([correct, false, np.full_like(correct, np.count_nonzero(truth))], axis=-1)


def select_threshold(
    tallies: Int64[np.ndarray, "kernels t 3"],
    kernels: Sequence[float],
    thresholds: Float32[np.ndarray, " t"],
) -> SelectedThreshold:
    """The kernel and threshold with the highest pooled IoU.

    Ties go to the smallest kernel, then to the threshold nearest 0.5.

    Args:
        tallies: summed over all validation runs.
        kernels: candidates, metres.
        thresholds: candidates, ascending.
    """
    values: Float64[np.ndarray, "kernels t"] = iou(tallies)
    tied = np.argwhere(values == values.max())
    row, column = min(tied.tolist(), key=lambda at: (kernels[at[0]], abs(thresholds[at[1]] - 0.5)))
    return SelectedThreshold(
        round(float(thresholds[column]), 6), float(kernels[row]), float(values[row, column])
    )
