"""Sparse viewpoints of the evaluation (the paper's Algorithm 1)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from imagination.geometry.grid import Grid
from imagination.scenes.scene import FreeSpace
from imagination.utils.errors import UserError, check_range


class Viewpoints(NamedTuple):
    """One set of viewpoints of a scene; metres, world frame.

    Attributes:
        points: points that Algorithm 1 returns, some of them inside furniture.
        snapped: centre of the nearest free cell of each point; several points may share one.
        distance: distance from each point to the centre of its free cell.
    """

    points: Float[np.ndarray, "n 2"]
    snapped: Float[np.ndarray, "n 2"]
    distance: Float[np.ndarray, " n"]


def sparse_viewpoints(free: FreeSpace, cell_width: float, rng: np.random.Generator) -> Viewpoints:
    """Draw one random set of viewpoints about `cell_width` apart (Algorithm 1).

    The set is empty if no point of the mesh grid is on free space, which happens where the cell width is not much
    smaller than the scene.

    A mesh grid of that spacing starts at the lower left of the free space's bounding box and runs along x first. Its
    points on free space are selected before any offset is added. One offset from ± cell_width / 2 in x and y shifts
    all of them, and a second offset from ± cell_width / 6 is drawn for each point.

    Args:
        free: free space for the robot, one connected component.
        cell_width: spacing of the viewpoints, metres.
        rng: random generator of the offsets.

    Raises:
        UserError: if the cell width is out of range, or no cell is free.
    """
    check_range("cell_width", cell_width, 0.1, 100.0, "m")
    if not free.mask.any():
        raise UserError("free space: got none, expected at least one free cell to place viewpoints on")
    candidates = _mesh_grid(free, cell_width)
    points = candidates[_is_free(free.mask, free.grid, candidates)]
    points = points + rng.uniform(-cell_width / 2, cell_width / 2, 2)
    points = points + rng.uniform(-cell_width / 6, cell_width / 6, points.shape)
    centres = free.grid.to_points(np.argwhere(free.mask))
    nearest = [int(np.argmin(((centres - point) ** 2).sum(axis=1))) for point in points]
    snapped = centres[np.array(nearest, np.int64)]
    return Viewpoints(points, snapped, np.linalg.norm(points - snapped, axis=1))


def _mesh_grid(free: FreeSpace, cell_width: float) -> Float[np.ndarray, "n 2"]:
    """Return the points of the mesh grid from the lowest to the highest centre of a free cell, along x first."""
    centres = free.grid.to_points(np.argwhere(free.mask))
    low, high = centres.min(axis=0), centres.max(axis=0) + 1e-6
    x, y = np.meshgrid(np.arange(low[0], high[0], cell_width), np.arange(low[1], high[1], cell_width))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _is_free(
    mask: Bool[np.ndarray, "h w"], grid: Grid, points: Float[np.ndarray, "n 2"]
) -> Bool[np.ndarray, " n"]:
    cells = grid.to_cells(points)
    free: np.ndarray = mask[cells[:, 0], cells[:, 1]]
    return free
