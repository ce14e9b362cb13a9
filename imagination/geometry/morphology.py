"""Dilation and closing of masks with square kernels, configured in metres (docs/concepts/conventions.md)."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from imagination.utils.errors import UserError, check_range

Layers = Bool[np.ndarray, "*b h w"] | Float32[np.ndarray, "*b h w"]
"""Masks, or scores >= 0: grey-scale morphology (maximum and minimum filters), which commutes with thresholding."""


def kernel_cells(size: float, resolution: float) -> int:
    """Return the side of a kernel in cells: round(size / resolution), at least 1. Kernels become cells only here.

    Args:
        size: side of the kernel, metres.
        resolution: side of a cell, metres.

    Raises:
        UserError: if an argument is out of range.

    >>> kernel_cells(0.6, 0.02), kernel_cells(1.0, 0.02), kernel_cells(0.62, 0.02), kernel_cells(0.62, 0.06)
    (30, 50, 31, 10)
    """
    check_range("resolution", resolution, 0.005, 1.0, "m")
    return max(1, round(check_range("kernel", size, 0.0, 100.0, "m") / resolution))


def dilate(mask: Layers, kernel: int) -> Layers:
    """Dilate by a square that covers the offsets -((kernel - 1) // 2) to kernel // 2 from each True cell.

    A square with an even side has no central cell: it extends one cell further down and right (OpenCV's anchor).

    Args:
        mask: one map, or several with leading axes.
        kernel: side of the square, cells.

    Raises:
        UserError: if the kernel is smaller than one cell.

    >>> dilate(np.array([[False, False, True, False, False]]), 4).astype(int)
    array([[0, 1, 1, 1, 1]])
    """
    square = _square(kernel)
    return _map_layers(mask, lambda cells: cv2.dilate(cells, square))


def close(mask: Layers, kernel: int) -> Layers:
    """Close gaps narrower than the kernel: dilate, then erode by the same offsets, so that no True cell is lost.

    Cells outside the map are False, and dilation beyond the border is kept until the erosion: the result equals that
    inside a larger empty map.

    Args:
        mask: one map, or several with leading axes.
        kernel: side of the square, cells.

    Raises:
        UserError: if the kernel is smaller than one cell.

    >>> close(np.array([[True, False, False, True, False]]), 3).astype(int)
    array([[1, 1, 1, 1, 0]])
    """
    square = _square(kernel)
    anchor = (kernel - 1) // 2

    def close_one(cells: np.ndarray) -> np.ndarray:
        padded = cv2.copyMakeBorder(cells, kernel, kernel, kernel, kernel, cv2.BORDER_CONSTANT, value=0)
        closed = cv2.erode(cv2.dilate(padded, square), square, anchor=(anchor, anchor))
        return closed[kernel:-kernel, kernel:-kernel]

    return _map_layers(mask, close_one)


def _square(kernel: int) -> np.ndarray:
    if kernel < 1:
        raise UserError(f"kernel: got {kernel} cells, expected at least 1")
    return np.ones((kernel, kernel), np.uint8)


def _map_layers(mask: np.ndarray, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Apply a function to each map of a stack, masks as uint8 for OpenCV."""
    out = np.empty_like(mask)
    for index in np.ndindex(mask.shape[:-2]):
        out[index] = function(mask[index].view(np.uint8) if mask.dtype == bool else mask[index])
    return out
