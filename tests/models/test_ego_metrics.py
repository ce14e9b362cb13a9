"""Scores of egocentric maps, compared with OpenCV and values computed by hand."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from imagination.models.ego_metrics import (
    THRESHOLDS,
    EgoScores,
    best_thresholds,
    dilate,
    named_scores,
    neighbourhood,
)

HALF = THRESHOLDS.index(0.5)


@settings(max_examples=40, deadline=None)
@given(
    kernel=st.integers(1, 12), rows=st.integers(1, 20), columns=st.integers(1, 20), seed=st.integers(0, 1000)
)
def test_dilate_is_opencv_s(kernel: int, rows: int, columns: int, seed: int) -> None:
    mask = np.random.default_rng(seed).random((2, 1, rows, columns)) < 0.1
    dilated = dilate(torch.from_numpy(mask), kernel).numpy()
    for view in range(2):
        # OpenCV's anchor is at k // 2: a marked cell spreads over -(k - 1)//2 to k//2
        expected = cv2.dilate(
            mask[view, 0].astype(np.uint8), np.ones((kernel, kernel), np.uint8), iterations=1
        )
        np.testing.assert_array_equal(dilated[view, 0], expected > 0)


@pytest.mark.parametrize(
    ("kernel", "low", "high"), [(1, 0, 0), (2, 0, 1), (3, -1, 1), (10, -4, 5), (31, -15, 15)]
)
def test_dilate_covers_the_documented_offsets(kernel: int, low: int, high: int) -> None:
    mask = torch.zeros(1, 1, 41, 41, dtype=torch.bool)
    mask[0, 0, 20, 20] = True
    rows, columns = dilate(mask, kernel)[0, 0].nonzero().T
    assert (rows.min().item() - 20, rows.max().item() - 20) == (low, high)
    assert (columns.min().item() - 20, columns.max().item() - 20) == (low, high)


def test_neighbourhood_dilates_only_likely_seen_cells() -> None:
    probabilities = torch.zeros(1, 1, 9, 9)
    probabilities[0, 0, 1, 1], probabilities[0, 0, 7, 7], probabilities[0, 0, 1, 7] = 0.7, 0.7, 0.3
    seen = torch.ones(1, 1, 9, 9, dtype=torch.uint8)
    seen[0, 0, 7, 7] = 0
    expected = torch.zeros(9, 9, dtype=torch.bool)
    expected[0:3, 0:3] = True
    assert torch.equal(neighbourhood(probabilities, seen, 3, 0.5)[0, 0], expected)


def test_scores_by_hand() -> None:
    probabilities = torch.zeros(1, 1, 5, 5)
    seen = torch.zeros(1, 1, 5, 5, dtype=torch.uint8)
    label = torch.zeros(1, 1, 5, 5, dtype=torch.uint8)
    seen[..., :2] = 1  # the two columns at the left
    probabilities[0, 0, 0, 0:3] = 0.9  # 2 seen, 1 unseen next to them
    probabilities[0, 0, 4, 4] = 0.9  # far from anything seen: filtered
    label[0, 0, 0:2, 1:3] = 1  # 2 seen, 2 unseen
    scores = EgoScores(1, kernel=3)
    scores.update(probabilities, label, seen)
    named = named_scores(scores.compute(), torch.tensor([HALF]), ["chair"])
    values = {name: value.item() for name, value in named.items()}
    assert values == pytest.approx(
        {
            "iou": 2 / 5, "precision": 2 / 3, "recall": 2 / 4,
            "iou_seen": 1 / 3, "precision_seen": 1 / 2, "recall_seen": 1 / 2,
            "iou_unseen": 1 / 2, "precision_unseen": 1, "recall_unseen": 1 / 2,
        }
    )  # fmt: skip


def test_cells_are_pooled_over_views_and_categories_averaged() -> None:
    seen = torch.ones(2, 1, 4, 4, dtype=torch.uint8)
    label = torch.zeros(2, 2, 4, 4, dtype=torch.uint8)
    label[0, 0, 0, 0] = 1  # one cell in one view, three in the other; only the first is predicted
    label[1, 0, 3, :3] = 1
    label[0, 1, 2, 2] = 1
    probabilities = torch.zeros(2, 2, 4, 4)
    probabilities[0, 0, 0, 0], probabilities[0, 1, 2, 2] = 1.0, 1.0
    pooled, separate = EgoScores(2, 1), EgoScores(2, 1)
    pooled.update(probabilities, label, seen)
    for view in range(2):
        separate.update(probabilities[view : view + 1], label[view : view + 1], seen[view : view + 1])
    assert torch.equal(pooled.compute(), separate.compute())
    named = named_scores(pooled.compute(), torch.tensor([HALF, HALF]), ["chair", "bed"])
    assert named["iou_chair"].item() == 0.25
    assert named["iou"].item() == pytest.approx((0.25 + 1) / 2)


def test_nothing_predicted_and_nothing_true_is_zero() -> None:
    scores = EgoScores(1, 3)
    empty = torch.zeros(1, 1, 5, 5, dtype=torch.uint8)
    scores.update(torch.zeros(1, 1, 5, 5), empty, empty)
    named = named_scores(scores.compute(), torch.tensor([HALF]), ["chair"])
    assert all(value.item() == 0 for value in named.values())


def test_each_category_gets_the_threshold_of_its_highest_iou() -> None:
    label, seen = torch.zeros(1, 2, 2, 2, dtype=torch.uint8), torch.ones(1, 1, 2, 2, dtype=torch.uint8)
    label[0, :, 0, 0] = 1
    probabilities = torch.tensor([[0.87, 0.83, 0.0, 0.0], [0.62, 0.57, 0.57, 0.0]]).view(1, 2, 2, 2)
    scores = EgoScores(2, 4)
    scores.update(probabilities, label, seen)
    selected = best_thresholds(scores.compute())
    assert [THRESHOLDS[index] for index in selected] == [0.85, 0.6]
    assert named_scores(scores.compute(), selected, ["chair", "bed"])["iou"].item() == 1
