"""Pooled and mean IoU of one training seed, written out for comparison with the estimates of the tables."""

import numpy as np
from jaxtyping import Float64, Int64

from imagination.evaluation.metrics import iou


def pooled_iou(counts: Int64[np.ndarray, "scenes sets 3"]) -> float:
    """Return the IoU of the summed counts of all trials, in which large scenes have more weight."""
    return float(iou(counts.sum(axis=(0, 1))))


def mean_iou(counts: Int64[np.ndarray, "scenes sets 3"]) -> float:
    """Return the mean IoU over trials, in which every trial has the same weight."""
    return float(iou(counts).mean())


def bootstrap_iou(
    counts: Int64[np.ndarray, "scenes sets 3"], draws: Int64[np.ndarray, "resamples scenes"]
) -> Float64[np.ndarray, " resamples"]:
    """Return the pooled IoU of each resample; the trials of a scene stay together, as they share its furniture."""
    return iou(draws @ counts.sum(axis=1))
