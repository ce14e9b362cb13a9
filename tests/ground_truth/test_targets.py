"""Masks and labels against hand-made maps and brute force."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from imagination.ground_truth.targets import imaginable_mask, label, neighbourhood

MASKS = st.tuples(
    *(arrays(np.bool_, (2, 3, 9, 9), elements=st.booleans()) for _ in range(2)), st.integers(1, 6)
)


def read(*rows: str) -> np.ndarray:
    return np.array([[cell == "#" for cell in row] for row in rows])


OBJECTS = read(
    ".......",
    "###....",
    ".......",
    ".......",
    ".....##",
    "...##..",
    ".......",
)
SEEN = read(
    ".......",
    ".......",
    ".......",
    ".......",
    ".......",
    "..##...",
    "..##...",
)


def test_by_hand() -> None:
    """Only the cell in row 5, column 3 is both object and seen; a kernel of 4 reaches one back and two forth."""
    expected = read(
        ".......",
        ".......",
        ".......",
        ".......",
        "..####.",
        "..####.",
        "..####.",
    )
    np.testing.assert_array_equal(neighbourhood(OBJECTS, SEEN, 4), expected)
    np.testing.assert_array_equal(imaginable_mask(OBJECTS, SEEN, 4), expected)
    np.testing.assert_array_equal(
        label(OBJECTS, SEEN, 4),
        read(".......", ".......", ".......", ".......", ".....#.", "...##..", "......."),
    )


@pytest.mark.parametrize("function", [neighbourhood, imaginable_mask, label])
def test_nothing_seen_nothing_to_imagine(function: Callable[..., np.ndarray]) -> None:
    assert not function(OBJECTS, np.zeros_like(SEEN), 4).any()


def test_one_seen_map_is_broadcast_to_all_layers() -> None:
    objects = np.stack([OBJECTS, SEEN, OBJECTS.T])[None]
    together = label(objects, SEEN[None, None], 3)
    assert together.shape == objects.shape
    for layer in range(3):
        np.testing.assert_array_equal(together[0, layer], label(objects[0, layer], SEEN, 3))


@given(MASKS)
def test_by_brute_force(masks: tuple[np.ndarray, np.ndarray, int]) -> None:
    objects, seen, kernel = masks
    expected = np.zeros_like(objects)
    for b, c, row, column in np.argwhere(objects & seen):
        top, left = max(row - (kernel - 1) // 2, 0), max(column - (kernel - 1) // 2, 0)
        expected[b, c, top : row + kernel // 2 + 1, left : column + kernel // 2 + 1] = True
    np.testing.assert_array_equal(neighbourhood(objects, seen, kernel), expected)
    np.testing.assert_array_equal(label(objects, seen, kernel), expected & objects)
