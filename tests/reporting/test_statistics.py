"""Estimates over scenes and training seeds, compared with sums and resamples written out."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagination.evaluation.metrics import interval, resample
from imagination.evaluation.record_files import PIXELS
from imagination.reporting.statistics import (
    MIN_SCENES,
    Bootstrap,
    counts_of,
    deviation,
    difference,
    estimate,
)
from imagination.reporting.tables import mapping
from tests.helpers.pooled import bootstrap_iou, pooled_iou

BOOTSTRAP = Bootstrap(300, 1)


def make_trials(seeds: list[int], scenes: int, drawn: int, sets: int = 2) -> pd.DataFrame:
    rng = np.random.default_rng(drawn)
    rows = []
    for seed in seeds:
        for scene in range(scenes):
            for number in range(sets):
                correct, false = rng.integers(0, 50, 2).tolist()
                rows.append((seed, "mine", "chair", 3.0, f"s{scene}", number, correct, false, 60 + scene))
    columns = ["seed", "approach", "category", "cell_width", "scene", "viewpoint_set", *PIXELS]
    return pd.DataFrame(rows, columns=columns)


def test_one_seed_has_the_interval_of_the_pooled_iou() -> None:
    trials = make_trials([5], 7, 0)
    found = estimate(counts_of(trials), BOOTSTRAP)
    counts = trials[list(PIXELS)].to_numpy().reshape(7, 2, 3)
    assert found.value == pooled_iou(counts)
    assert (found.low, found.high) == interval(bootstrap_iou(counts, resample(7, 300, 1)))
    assert math.isnan(found.seed_std)


def test_several_seeds_have_a_mean_a_deviation_and_the_interval_of_the_mean() -> None:
    trials = make_trials([3, 1, 2], 6, 1)
    counts = {seed: part[list(PIXELS)].to_numpy().reshape(6, 2, 3) for seed, part in trials.groupby("seed")}
    values = [pooled_iou(each) for each in counts.values()]
    found = estimate(counts_of(trials), BOOTSTRAP)
    assert found.value == pytest.approx(np.mean(values))
    assert found.seed_std == pytest.approx(np.std(values, ddof=1))
    means = []
    for picked in resample(6, 300, 1):  # the same scenes for all seeds
        totals = [np.tensordot(picked, each.sum(axis=1), axes=1) for each in counts.values()]
        means.append(np.mean([total[0] / (total[1] + total[2]) for total in totals]))
    assert (found.low, found.high) == pytest.approx(tuple(np.quantile(means, [0.025, 0.975])))


@pytest.mark.parametrize("scenes", [MIN_SCENES - 1, MIN_SCENES])
def test_few_scenes_have_no_interval(scenes: int) -> None:
    found = estimate(counts_of(make_trials([0, 1], scenes, 2)), BOOTSTRAP)
    assert math.isfinite(found.low) == math.isfinite(found.high) == (scenes >= MIN_SCENES)
    assert math.isfinite(found.value) and math.isfinite(found.seed_std)


@given(st.permutations([4, 7, 9]), st.integers(0, 1000))
def test_differences_are_paired_by_seed_and_scene(order: list[int], drawn: int) -> None:
    """The order of the seeds changes nothing, and a job minus itself has no spread."""
    trials = make_trials([4, 7, 9], 6, drawn)
    shuffled = pd.concat([trials[trials["seed"] == seed] for seed in order])
    shuffled = shuffled.sort_values("scene", ascending=False, kind="stable")
    same = difference(trials, shuffled, BOOTSTRAP, "iou")
    assert same is not None and tuple(same.estimate) == (0.0, 0.0, 0.0, 0.0)
    better = shuffled.assign(correct_pixels=shuffled["correct_pixels"] + 5)
    found = difference(better, trials, BOOTSTRAP, "correct_pixels")
    assert found is not None and (found.seeds, found.scenes) == (3, 6)
    assert tuple(found.estimate) == pytest.approx((60.0, 60.0, 60.0, 0.0))


def test_a_group_with_holes_equals_itself() -> None:
    """One seed lacks a scene, another a viewpoint set; both are left out on both sides."""
    trials = make_trials([4, 7, 9], 8, 0)
    holes = (trials["seed"] == 7) & (trials["scene"] == "s1")
    holes |= (trials["seed"] == 9) & (trials["scene"] == "s3") & (trials["viewpoint_set"] == 1)
    for one, other in ((trials, trials[~holes]), (trials[~holes], trials)):
        found = difference(one, other, BOOTSTRAP, "iou")
        assert found is not None and found.scenes == 7
        assert tuple(found.estimate) == (0.0, 0.0, 0.0, 0.0)


def test_differences_use_the_trials_and_seeds_of_both() -> None:
    ours, theirs = make_trials([0, 1, 2], 8, 3), make_trials([1, 2, 3], 8, 4)
    ours = ours[ours["scene"] != "s0"]
    found = difference(ours, theirs, BOOTSTRAP, "iou")
    common = [part[part["seed"].isin([1, 2]) & (part["scene"] != "s0")] for part in (ours, theirs)]
    values = [
        [pooled_iou(each[list(PIXELS)].to_numpy()[None]) for _, each in part.groupby("seed")]
        for part in common
    ]
    assert found is not None and (found.seeds, found.scenes) == (2, 7)
    assert found.estimate.value == pytest.approx(np.mean(values[0]) - np.mean(values[1]))
    assert found.estimate.seed_std == pytest.approx(np.std(np.subtract(*values), ddof=1))


def test_without_a_common_seed_the_means_are_compared() -> None:
    ours, theirs = make_trials([0, 1], 6, 5), make_trials([2, 3], 6, 6)
    found = difference(ours, theirs, BOOTSTRAP, "iou")
    assert found is not None and found.seeds == 0
    assert math.isnan(found.estimate.seed_std) and math.isfinite(found.estimate.low)
    values = [estimate(counts_of(part), BOOTSTRAP).value for part in (ours, theirs)]
    assert found.estimate.value == pytest.approx(values[0] - values[1])
    assert difference(ours, theirs.assign(scene="other"), BOOTSTRAP, "iou") is None


def test_a_scene_that_a_seed_lacks_is_left_out() -> None:
    trials = make_trials([0, 1], 6, 7)
    trials = trials[(trials["seed"] == 0) | (trials["scene"] != "s2")]
    assert counts_of(trials).shape == (2, 5, 3)
    assert counts_of(trials)[0, :, 2].tolist() == [2 * (60 + scene) for scene in (0, 1, 3, 4, 5)]


def test_no_common_trial_has_no_value() -> None:
    trials = make_trials([0, 1], 2, 8)
    trials = trials[(trials["seed"] == 0) == (trials["scene"] == "s0")]
    assert math.isnan(estimate(counts_of(trials), BOOTSTRAP).value)
    row = mapping(trials, BOOTSTRAP).iloc[0]
    assert math.isnan(row["iou_pooled"]) and math.isnan(row["iou_mean"]) and row["trials"] == 0


def test_one_value_has_no_deviation() -> None:
    assert math.isnan(deviation([0.5])) and deviation([1.0, 3.0]) == pytest.approx(math.sqrt(2))
