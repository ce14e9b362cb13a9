import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from imagination.geometry.grid import cells_of
from imagination.geometry.morphology import close, dilate, kernel_cells
from imagination.utils.errors import UserError

masks = arrays(np.bool_, st.tuples(st.integers(1, 12), st.integers(1, 12)))
kernels = st.integers(1, 9)


def dilate_by_loops(mask: np.ndarray, kernel: int) -> np.ndarray:
    out = np.zeros_like(mask)
    for row, column in np.argwhere(mask):
        for dr in range(-((kernel - 1) // 2), kernel // 2 + 1):
            for dc in range(-((kernel - 1) // 2), kernel // 2 + 1):
                if 0 <= row + dr < mask.shape[0] and 0 <= column + dc < mask.shape[1]:
                    out[row + dr, column + dc] = True
    return out


@pytest.mark.parametrize(
    ("size", "resolution", "cells"),
    [
        (0.6, 0.02, 30),
        (1.0, 0.02, 50),
        (0.62, 0.02, 31),
        (0.6, 0.06, 10),
        (1.0, 0.06, 17),
        (0.62, 0.06, 10),
        (0.001, 0.02, 1),
        (0.0, 0.02, 1),
        (0.029, 0.02, 1),
        (0.031, 0.02, 2),
    ],
)
def test_kernels_in_cells(size: float, resolution: float, cells: int) -> None:
    assert kernel_cells(size, resolution) == cells


@pytest.mark.parametrize(
    ("extent", "resolution", "cells"),
    [(5.22, 0.02, 261), (40.02, 0.02, 2001), (5.22, 0.06, 87), (40.02, 0.06, 667)],
)
def test_maps_in_cells(extent: float, resolution: float, cells: int) -> None:
    assert cells_of(extent, resolution) == cells


@pytest.mark.parametrize(
    ("size", "resolution"), [(-0.1, 0.02), (float("nan"), 0.02), (101.0, 0.02), (0.6, 0.0), (0.6, -1.0)]
)
def test_kernel_out_of_range_is_refused(size: float, resolution: float) -> None:
    with pytest.raises(UserError, match="got .* expected a number in"):
        kernel_cells(size, resolution)


def test_kernel_of_no_cells_is_refused() -> None:
    for operation in (dilate, close):
        with pytest.raises(UserError, match="kernel: got 0 cells, expected at least 1"):
            operation(np.zeros((3, 3), np.bool_), 0)


def test_even_kernel_reaches_further_down_and_right() -> None:
    mask = np.zeros((7, 7), np.bool_)
    mask[3, 3] = True
    rows, columns = np.nonzero(dilate(mask, 4))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (2, 5, 2, 5)


@given(masks, kernels)
def test_dilation_is_that_of_the_loops(mask: np.ndarray, kernel: int) -> None:
    assert np.array_equal(dilate(mask, kernel), dilate_by_loops(mask, kernel))


@given(masks, kernels)
def test_odd_dilation_is_scipys(mask: np.ndarray, kernel: int) -> None:
    size = 2 * kernel - 1
    assert np.array_equal(dilate(mask, size), ndimage.binary_dilation(mask, np.ones((size, size))))


@pytest.mark.parametrize("kernel", [30, 50, 31])
def test_dilation_at_paper_size_is_opencvs(kernel: int) -> None:
    mask = np.random.default_rng(kernel).random((2, 3, 261, 261)) < 0.002
    square = np.ones((kernel, kernel), np.uint8)
    for index in np.ndindex(2, 3):
        assert np.array_equal(
            dilate(mask, kernel)[index], cv2.dilate(mask[index].astype(np.uint8), square) > 0
        )


@given(masks, kernels)
def test_closing_is_that_of_a_larger_empty_map(mask: np.ndarray, kernel: int) -> None:
    room = 3 * kernel
    closed = ndimage.binary_closing(np.pad(mask, room), np.ones((kernel, kernel)))
    assert np.array_equal(close(mask, kernel), closed[room:-room, room:-room])


@given(masks, kernels)
def test_closing_loses_nothing_and_is_done_at_once(mask: np.ndarray, kernel: int) -> None:
    closed = close(mask, kernel)
    assert closed[mask].all()
    assert np.array_equal(close(closed, kernel), closed)
    assert not close(np.zeros_like(mask), kernel).any()


def test_closing_fills_stripes_but_not_the_gap_to_the_rim() -> None:
    stripes = np.zeros((20, 20), np.bool_)
    stripes[2:17:3] = True
    closed = close(stripes, 3)
    assert closed[2:15].all()
    assert not closed[:2].any()
    assert not closed[18:].any()


@settings(max_examples=50)
@given(arrays(np.bool_, (9, 9)), st.integers(0, 4), st.integers(0, 3), st.integers(-3, 3), st.integers(-3, 3))
def test_odd_kernels_commute_with_turns_and_shifts(
    mask: np.ndarray, half: int, turns: int, dr: int, dc: int
) -> None:
    kernel = 2 * half + 1
    for operation in (dilate, close):
        assert np.array_equal(
            np.rot90(operation(mask, kernel), turns), operation(np.rot90(mask, turns).copy(), kernel)
        )
        wide = np.pad(mask, 3 + kernel)
        assert np.array_equal(
            np.roll(operation(wide, kernel), (dr, dc), (0, 1)),
            operation(np.roll(wide, (dr, dc), (0, 1)), kernel),
        )


@given(masks, kernels, st.floats(0, 1))
def test_scores_commute_with_thresholds(mask: np.ndarray, kernel: int, threshold: float) -> None:
    scores = np.random.default_rng(mask.size).random(mask.shape, dtype=np.float32)
    for operation in (dilate, close):
        assert np.array_equal(operation(scores, kernel) > threshold, operation(scores > threshold, kernel))
