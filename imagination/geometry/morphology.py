"""Growing and closing masks with square kernels, configured in metres (docs/conventions.md)."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from imagination.utils.errors import UserError, check_range

Layers = Bool[np.ndarray, "*b h w"] | Float32[np.ndarray, "*b h w"]
"""Masks, or scores from 0 up: of which a square takes the largest or smallest, so that they commute with thresholds."""


def kernel_cells(size: float, resolution: float) -> int:
    """Cells a side of a kernel: round(size / resolution), at least 1. The only place where kernels become cells.

    Args:
        size: side of the square, metres.
        resolution: side of a cell, metres.

    Raises:
        UserError: if either is out of range.

    >>> kernel_cells(0.6, 0.02), kernel_cells(1.0, 0.02), kernel_cells(0.62, 0.02), kernel_cells(0.62, 0.06)
    (30, 50, 31, 10)
    """
    check_range("resolution", resolution, 0.005, 1.0, "m")
    return max(1, round(check_range("kernel", size, 0.0, 100.0, "m") / resolution))


def dilate(mask: Layers, kernel: int) -> Layers:
    """Grow each True cell to the square that covers the offsets -((kernel - 1) // 2) to kernel // 2 from it.

    A square of an even side cannot be centred: it reaches one cell further down and right (OpenCV's anchor).

    Args:
        mask: one map, or any number stacked in front.
        kernel: cells a side of the square.

    Raises:
        UserError: if the kernel is smaller than one cell.

    >>> dilate(np.array([[False, False, True, False, False]]), 4).astype(int)
    array([[0, 1, 1, 1, 1]])
    """
    square = _square(kernel)
    return _each(mask, lambda cells: cv2.dilate(cells, square))


def close(mask: Layers, kernel: int) -> Layers:
    """Fill gaps narrower than the kernel: dilation, then erosion by the same offsets, so that no True cell is lost.

    Cells outside the map are False, and growth beyond the rim is kept between the two steps: the result is what it
    would be inside a larger empty map.

    Args:
        mask: one map, or any number stacked in front.
        kernel: cells a side of the square.

    Raises:
        UserError: if the kernel is smaller than one cell.

    >>> close(np.array([[True, False, False, True, False]]), 3).astype(int)
    array([[1, 1, 1, 1, 0]])
    """
    square = _square(kernel)
    before = (kernel - 1) // 2

    def close_one(cells: np.ndarray) -> np.ndarray:
        padded = cv2.copyMakeBorder(cells, kernel, kernel, kernel, kernel, cv2.BORDER_CONSTANT, value=0)
        closed = cv2.erode(cv2.dilate(padded, square), square, anchor=(before, before))
        return closed[kernel:-kernel, kernel:-kernel]

    return _each(mask, close_one)


def _square(kernel: int) -> np.ndarray:
    if kernel < 1:
        raise UserError(f"kernel: got {kernel} cells, expected at least 1")
    return np.ones((kernel, kernel), np.uint8)


def _each(mask: np.ndarray, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Apply `change` to each map of the stack; OpenCV takes masks as uint8."""
    out = np.empty_like(mask)
    for index in np.ndindex(mask.shape[:-2]):
        out[index] = change(mask[index].view(np.uint8) if mask.dtype == bool else mask[index])
    return out
