"""Counts, IoU and bootstrap against numbers worked out by hand and plain loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from imagination.evaluation.metrics import count, interval, iou, resample
from tests.helpers.pooled import bootstrap_iou, mean_iou, pooled_iou

COUNTS = np.array([[[3, 1, 4], [2, 2, 4]], [[5, 0, 10], [10, 5, 10]]])
"""Two scenes with two viewpoint sets each: correct, false-positive and ground-truth pixels."""


def test_counts_by_hand() -> None:
    predicted = np.array([[1, 1, 0], [0, 1, 0]], bool)
    truth = np.array([[1, 0, 0], [1, 1, 1]], bool)
    assert count(predicted, truth).tolist() == [2, 1, 4]


def test_iou_by_hand() -> None:
    assert iou(COUNTS).tolist() == [[3 / 5, 2 / 6], [5 / 10, 10 / 15]]
    assert pooled_iou(COUNTS) == 20 / 36
    assert mean_iou(COUNTS) == pytest.approx((3 / 5 + 2 / 6 + 5 / 10 + 10 / 15) / 4)
    assert iou(np.array([0, 0, 0])) == 0


@given(arrays(bool, (4, 5)), arrays(bool, (4, 5)))
def test_iou_is_intersection_over_union(predicted: np.ndarray, truth: np.ndarray) -> None:
    union = (predicted | truth).sum()
    expected = (predicted & truth).sum() / union if union else 0.0
    assert iou(count(predicted, truth)) == pytest.approx(expected)


def test_bootstrap_equals_a_loop_over_resamples() -> None:
    draws = resample(2, 50, seed=3)
    assert (draws.sum(axis=1) == 2).all()
    for times, value in zip(draws, bootstrap_iou(COUNTS, draws), strict=True):
        scenes = [scene for scene, often in enumerate(times) for _ in range(often)]
        correct = sum(COUNTS[scene, :, 0].sum() for scene in scenes)
        union = sum(COUNTS[scene, :, 1].sum() + COUNTS[scene, :, 2].sum() for scene in scenes)
        assert value == pytest.approx(correct / union)


def test_bootstrap_follows_the_seed_alone() -> None:
    assert (resample(7, 100, seed=1) == resample(7, 100, seed=1)).all()
    assert (resample(7, 100, seed=1) != resample(7, 100, seed=2)).any()


@given(st.integers(1, 20))
def test_equal_scenes_give_an_interval_of_zero_width(scenes: int) -> None:
    counts = np.tile(np.array([[[3, 1, 4]]]), (scenes, 2, 1))
    low, high = interval(bootstrap_iou(counts, resample(scenes, 30, seed=0)))
    assert low == high == pytest.approx(3 / 5)


def test_interval_leaves_out_a_fortieth_on_each_side() -> None:
    low, high = interval(np.arange(1001) / 1000)
    assert (low, high) == (pytest.approx(0.025), pytest.approx(0.975))
