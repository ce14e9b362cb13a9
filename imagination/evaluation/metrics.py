"""How well a global map agrees with the truth: counts, intersection over union, and bootstrap intervals over scenes."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

CONFIDENCE = 0.95
"""Of every interval in the tables."""


class Interval(NamedTuple):
    """A bootstrap interval."""

    low: float
    high: float


def count(predicted: Bool[np.ndarray, "h w"], truth: Bool[np.ndarray, "h w"]) -> Int64[np.ndarray, "3"]:
    """Correct, false and truth pixels of one map; those missed are truth minus correct."""
    correct = int(np.count_nonzero(predicted & truth))
    return np.array([correct, np.count_nonzero(predicted) - correct, np.count_nonzero(truth)], np.int64)


def iou(counts: Int64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n"]:
    """Intersection over union, correct / (truth + false), of each triple of counts; 0 where both maps are empty."""
    union = counts[..., 2] + counts[..., 1]
    result: Float64[np.ndarray, "*n"] = np.divide(
        counts[..., 0], union, out=np.zeros(union.shape), where=union > 0
    )
    return result


def pooled_iou(counts: Int64[np.ndarray, "scenes sets 3"]) -> float:
    """IoU of all runs taken together: large scenes count for more."""
    return float(iou(counts.sum(axis=(0, 1))))


def mean_iou(counts: Int64[np.ndarray, "scenes sets 3"]) -> float:
    """Mean of the IoU of each run: every run counts the same."""
    return float(iou(counts).mean())


def resample(scenes: int, resamples: int, seed: int) -> Int64[np.ndarray, "resamples scenes"]:
    """How often each scene is drawn in each resample of as many scenes, with replacement.

    The same arguments give the same draws, so two approaches resampled with them are compared in pairs.
    """
    rng = np.random.default_rng(seed)
    return rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=resamples)


def bootstrap_iou(
    counts: Int64[np.ndarray, "scenes sets 3"], draws: Int64[np.ndarray, "resamples scenes"]
) -> Float64[np.ndarray, " resamples"]:
    """Pooled IoU of each resample; the runs of a scene stay together, because they share its furniture."""
    return iou(draws @ counts.sum(axis=1))


def interval(samples: Float64[np.ndarray, " resamples"]) -> Interval:
    """The percentile interval of bootstrap samples at `CONFIDENCE`."""
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(samples, [tail, 1 - tail])
    return Interval(float(low), float(high))
