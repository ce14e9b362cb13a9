"""Estimates from the counts of trials: values with intervals over scenes and deviations over training seeds.

Every table and figure takes its numbers from here. A value of several training seeds is the mean over seeds. The
interval is a percentile bootstrap over scenes: each resample contains the same scenes for all seeds, approaches and
jobs, so that differences are paired. The standard deviation over seeds is that of a sample (n - 1).
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float64, Int64

from imagination.evaluation.metrics import interval, iou, resample
from imagination.evaluation.record_files import PIXELS

MIN_SCENES = 5
"""Minimum number of scenes for an interval over scenes."""

KEY = ["approach", "category", "cell_width"]
"""Columns that identify a row of the results table."""

VIEWPOINT_SET = ["cell_width", "scene", "viewpoint_set"]
"""Columns that identify a viewpoint set, of which a row of the results table has one trial for each training seed."""

Counts = Int64[np.ndarray, "seeds scenes 3"]
"""Correct, false-positive and ground-truth pixels, summed over the viewpoint sets of each scene."""

Measure = Callable[[Int64[np.ndarray, "*n 3"]], Float64[np.ndarray, "*n"]]
"""Metric of counts."""

MEASURES: Mapping[str, Measure] = {"iou": iou, "correct_pixels": lambda counts: counts[..., 0].astype(float)}
"""Metrics by name."""


class Bootstrap(NamedTuple):
    """Bootstrap over scenes.

    Attributes:
        resamples: number of resamples.
        seed: seed of the resamples.
    """

    resamples: int
    seed: int

    def draws(self, scenes: int) -> Int64[np.ndarray, "resamples scenes"] | None:
        """Return how often each resample contains each scene; None if there are too few scenes."""
        return resample(scenes, self.resamples, self.seed) if scenes >= MIN_SCENES else None


class Estimate(NamedTuple):
    """Value with its uncertainty.

    Attributes:
        value: mean over seeds.
        low, high: interval over scenes; NaN if there are fewer than `MIN_SCENES`.
        seed_std: standard deviation over seeds; NaN for a single seed.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    seed_std: float = math.nan


def groups(trials: pd.DataFrame) -> Iterator[tuple[tuple[Any, ...], pd.DataFrame]]:
    """Yield approach, category and cell width with their trials, in the order of the records."""
    yield from trials.groupby(KEY, sort=False)


def select(trials: pd.DataFrame, approach: str, category: str, cell_width: float) -> pd.DataFrame:
    """Return the trials of a row of the results table."""
    columns = zip(KEY, (approach, category, cell_width), strict=True)
    return trials[np.logical_and.reduce([trials[name] == value for name, value in columns])]


def of_all_seeds(trials: pd.DataFrame) -> pd.DataFrame:
    """Return the trials of one row of the results table that every training seed has."""
    seeds = trials["seed"].nunique()
    if seeds == 1:
        return trials
    found = trials.groupby(VIEWPOINT_SET, sort=False)["seed"].transform("nunique")
    return trials[found == seeds]


def counts_of(trials: pd.DataFrame, suffix: str = "", scenes: Sequence[str] | None = None) -> Counts:
    """Sum the counts of trials over viewpoint sets and cell widths; trials that a seed lacks are left out.

    Args:
        trials: trials of one approach and category.
        suffix: suffix of the columns; see `record_files`.
        scenes: names of the scenes in their order; by default that of the trials.
    """
    trials = of_all_seeds(trials)
    values = trials[[f"{name}{suffix}" for name in PIXELS]].to_numpy(np.int64)
    seeds, seed = np.unique(trials["seed"].to_numpy(), return_inverse=True)
    scenes = list(trials["scene"].unique()) if scenes is None else scenes
    places = {name: place for place, name in enumerate(scenes)}
    counts = np.zeros((len(seeds), len(scenes), 3), np.int64)
    scene = np.array([places[name] for name in trials["scene"]], np.intp)
    np.add.at(counts, (seed, scene), values)
    return counts


def estimate(counts: Counts, bootstrap: Bootstrap, measure: str = "iou") -> Estimate:
    """Estimate a metric pooled over scenes; NaN without any."""
    if not counts.size:
        return Estimate(math.nan)
    return _estimate(_values(counts, measure), _samples(counts, bootstrap, measure))


class Difference(NamedTuple):
    """Paired difference of two groups of trials.

    Attributes:
        estimate: difference of the metric.
        seeds: number of training seeds that both have; 0 if only the means over seeds are compared.
        scenes: number of scenes that both have.
    """

    estimate: Estimate
    seeds: int
    scenes: int


def difference(
    ours: pd.DataFrame, theirs: pd.DataFrame, bootstrap: Bootstrap, measure: str
) -> Difference | None:
    """Estimate the paired difference of a metric over the trials and seeds that both have; None without any.

    If no training has the same seed in both, only the means over seeds are compared.
    """
    paired = set(ours["seed"]) & set(theirs["seed"])
    if paired:
        ours, theirs = (part[part["seed"].isin(paired)] for part in (ours, theirs))
    ours, theirs = common_trials(of_all_seeds(ours), of_all_seeds(theirs))
    if ours.empty:
        return None
    scenes = list(ours["scene"].unique())
    first, second = counts_of(ours, scenes=scenes), counts_of(theirs, scenes=scenes)
    samples = _samples(first, bootstrap, measure), _samples(second, bootstrap, measure)
    values = _values(first, measure), _values(second, measure)
    found = _estimate(
        values[0] - values[1] if paired else np.array([values[0].mean() - values[1].mean()]),
        None if samples[0] is None or samples[1] is None else samples[0] - samples[1],
    )
    return Difference(found, len(paired), len(scenes))


def common_trials(ours: pd.DataFrame, theirs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the trials of which both have results, for all their training seeds."""
    trials = [list(part[VIEWPOINT_SET].itertuples(index=False, name=None)) for part in (ours, theirs)]
    if trials[0] == trials[1]:
        return ours, theirs
    common = set(trials[0]) & set(trials[1])
    kept = [np.array([trial in common for trial in each], np.bool_) for each in trials]
    return ours[kept[0]], theirs[kept[1]]


def deviation(values: Sequence[float] | Float64[np.ndarray, " n"]) -> float:
    """Return the standard deviation of a sample; NaN for a single value."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def _values(counts: Counts, measure: str) -> Float64[np.ndarray, " seeds"]:
    """Return the metric of each seed."""
    values: Float64[np.ndarray, " seeds"] = MEASURES[measure](counts.sum(axis=1))
    return values


def _samples(counts: Counts, bootstrap: Bootstrap, measure: str) -> Float64[np.ndarray, " resamples"] | None:
    """Return the mean over seeds of the metric of each resample; None if there are too few scenes."""
    draws = bootstrap.draws(counts.shape[1])
    if draws is None:
        return None
    samples: Float64[np.ndarray, " resamples"] = MEASURES[measure](draws @ counts).mean(axis=0)
    return samples


def _estimate(
    values: Float64[np.ndarray, " seeds"], samples: Float64[np.ndarray, " resamples"] | None
) -> Estimate:
    low, high = (math.nan, math.nan) if samples is None else interval(samples)
    return Estimate(float(values.mean()), low, high, deviation(values))
