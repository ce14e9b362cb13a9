"""Selection of thresholds: the histogram against every threshold in a loop."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from imagination.evaluation.metrics import count
from imagination.evaluation.threshold_selection import THRESHOLDS, confusion_counts, reached, select_threshold

SCORES = st.one_of(
    st.floats(0, 1, width=32), st.sampled_from(THRESHOLDS.tolist()), st.sampled_from([0.0, 0.5, 1.0])
)


@given(arrays(np.float32, (5, 6), elements=SCORES), arrays(bool, (5, 6)))
def test_confusion_counts_equal_a_loop_over_thresholds(score: np.ndarray, truth: np.ndarray) -> None:
    expected = [count(score >= threshold, truth) for threshold in THRESHOLDS]
    assert confusion_counts(score, truth, THRESHOLDS).tolist() == np.stack(expected).tolist()
    levels = reached(score, THRESHOLDS)  # stored in saved maps
    assert all((levels > place).tolist() == (score >= t).tolist() for place, t in enumerate(THRESHOLDS))


def test_cells_that_no_view_wrote_are_in_no_map() -> None:
    assert (
        confusion_counts(np.zeros((3, 3), np.float32), np.ones((3, 3), bool), THRESHOLDS)[:, :2] == 0
    ).all()


def test_the_best_pair_is_chosen() -> None:
    rng = np.random.default_rng(0)
    thresholds = np.array([0.2, 0.5, 0.8], np.float32)
    tallies = rng.integers(1, 100, (4, 3, 3))
    tallies[..., 2] += 100
    best = max(
        (tallies[k, t, 0] / (tallies[k, t, 1] + tallies[k, t, 2]), k, t) for k in range(4) for t in range(3)
    )
    chosen = select_threshold(tallies, [0.0, 0.1, 0.2, 0.3], thresholds)
    assert np.isclose(chosen.iou, best[0])
    assert (chosen.kernel, chosen.threshold) == (
        [0.0, 0.1, 0.2, 0.3][best[1]],
        round(float(thresholds[best[2]]), 6),
    )


def test_ties_go_to_the_smallest_kernel_then_the_middle() -> None:
    tallies = np.tile(np.array([1, 1, 2]), (2, len(THRESHOLDS), 1))
    assert select_threshold(tallies, [0.3, 0.1], THRESHOLDS)[:2] == (0.5, 0.1)


def test_a_chosen_threshold_selects_the_cells_it_was_chosen_on() -> None:
    for threshold in THRESHOLDS:
        chosen = select_threshold(np.array([[[1, 0, 1]]]), [0.0], np.array([threshold], np.float32))
        assert np.float32(chosen.threshold) == threshold
