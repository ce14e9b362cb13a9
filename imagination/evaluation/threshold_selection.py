"""Selection of threshold and kernel of each approach on validation scenes, by IoU pooled over all trials."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from imagination.evaluation.metrics import iou

THRESHOLDS: Float32[np.ndarray, " t"] = (np.arange(1, 100) / 100).astype(np.float32)
"""Candidate thresholds, all above 0, so that a cell that no view updated is never part of a map."""


class SelectedThreshold(NamedTuple):
    """Threshold and kernel selected for one approach and category.

    Attributes:
        threshold: lowest score of a cell that belongs to the map.
        kernel: kernel of closing or dilation, metres; 0 where the approach does neither.
        iou: IoU pooled over the validation scenes.
    """

    threshold: float
    kernel: float
    iou: float


def reached(
    score: Float32[np.ndarray, "*shape"], thresholds: Float32[np.ndarray, " t"]
) -> Int64[np.ndarray, "*shape"]:
    """Return the number of thresholds (ascending) that each cell reaches; a threshold equal to the score counts."""
    return np.searchsorted(thresholds, score, side="right")


def confusion_counts(
    score: Float32[np.ndarray, "h w"], gt: Bool[np.ndarray, "h w"], thresholds: Float32[np.ndarray, " t"]
) -> Int64[np.ndarray, "t 3"]:
    """Count correct, false-positive and ground-truth pixels of [score >= threshold] in one pass over the map.

    Args:
        score: score of each cell.
        gt: ground-truth map.
        thresholds: thresholds in ascending order.
    """
    considered = score >= thresholds[0]
    bins = reached(score[considered], thresholds) - 1  # index of the highest threshold reached
    hits = gt[considered]

    def at_least(indices: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " t"]:
        return np.bincount(indices, minlength=len(thresholds))[::-1].cumsum()[::-1]

    correct, false = at_least(bins[hits]), at_least(bins[~hits])
    return np.stack([correct, false, np.full_like(correct, np.count_nonzero(gt))], axis=-1)


def select_threshold(
    counts: Int64[np.ndarray, "kernels t 3"],
    kernels: Sequence[float],
    thresholds: Float32[np.ndarray, " t"],
) -> SelectedThreshold:
    """Return the kernel and threshold with the highest pooled IoU.

    Ties go to the smallest kernel, then to the threshold nearest 0.5.

    Args:
        counts: confusion counts summed over all validation trials.
        kernels: candidate kernels, metres.
        thresholds: candidate thresholds in ascending order.
    """
    values: Float64[np.ndarray, "kernels t"] = iou(counts)
    tied = np.argwhere(values == values.max())
    row, column = min(tied.tolist(), key=lambda at: (kernels[at[0]], abs(thresholds[at[1]] - 0.5)))
    return SelectedThreshold(
        round(float(thresholds[column]), 6), float(kernels[row]), float(values[row, column])
    )
