"""Metrics of global maps: pixel counts, intersection over union (IoU), and bootstrap intervals over scenes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

CONFIDENCE = 0.95
"""Confidence level of every interval in the tables."""


class Interval(NamedTuple):
    """Bounds of a bootstrap confidence interval."""

    low: float
    high: float


def count(predicted: Bool[np.ndarray, "h w"], gt: Bool[np.ndarray, "h w"]) -> Int64[np.ndarray, "3"]:
    """Count correct, false-positive and ground-truth pixels of one map; missed pixels are the third minus the first."""
    correct = int(np.count_nonzero(predicted & gt))
    return np.array([correct, np.count_nonzero(predicted) - correct, np.count_nonzero(gt)], np.int64)


def iou(counts: Int64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n"]:
    """Return IoU = correct / (ground truth + false positives) of each triple of counts; 0 where both maps are empty."""
    union = counts[..., 2] + counts[..., 1]
    result: Float64[np.ndarray, "*n"] = np.divide(
        counts[..., 0], union, out=np.zeros(union.shape), where=union > 0
    )
    return result


def resample(scenes: int, resamples: int, seed: int) -> Int64[np.ndarray, "resamples scenes"]:
    """Draw bootstrap resamples of scenes with replacement; return how often each resample contains each scene.

    The same arguments give the same draws, so that differences between two approaches are paired.
    """
    rng = np.random.default_rng(seed)
    return rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=resamples)


def interval(samples: Float64[np.ndarray, " resamples"]) -> Interval:
    """Return the percentile interval of bootstrap samples at the level `CONFIDENCE`."""
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(samples, [tail, 1 - tail])
    return Interval(float(low), float(high))
