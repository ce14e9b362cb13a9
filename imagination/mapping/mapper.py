"""Registration of egocentric views with known poses into a global map (docs/concepts/conventions.md)."""

import os
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from imagination.geometry.crop import ego_to_grid
from imagination.geometry.grid import MAX_CELLS, EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.mapping.update_rules import UpdateRule
from imagination.utils.errors import UserError
from imagination.utils.jit import compiled

BYTES_PER_CELL = 8
"""Memory per cell and layer, bytes: probability (float32) and view count (int32, negative while only imagined)."""

SAVING_BYTES_PER_CELL = 64
"""Memory that saving a map needs per cell of the grid, bytes: drawing its picture holds four float images at once."""

CHUNK = 128
"""Number of rows or columns by which a map is extended at once, cells."""


class Mapper:
    """Global map of probabilities, one layer per category, into which views are registered.

    The first view that writes a cell sets its value. So does the first view that observes a cell which was only
    imagined before; otherwise a wrong prediction would outweigh later observations (docs/concepts/conventions.md).

    A view changes only the cells of its window, which are sampled by inverse mapping (bilinear for values, nearest for
    masks), so the cost depends on the size of the egocentric map and not on that of the global map.

    Args:
        grid: grid of the global map.
        ego: grid of the views, of the same resolution.
        categories: names of the layers.
        rule: update rule for cells that were written before.

    Raises:
        UserError: if the resolutions differ, there is no category, or the map is too large.

    >>> from imagination.mapping.update_rules import MovingAverage
    >>> ego = EgoGrid(resolution=1.0, cells=3)
    >>> mapper = Mapper(Grid.centred(5.0, 1.0), ego, ["chair"], MovingAverage(0.9))
    >>> for value in (1.0, 0.0):
    ...     mapper.register(np.full((1, 3, 3), value, np.float32), np.ones((1, 3, 3), bool), Pose(0.0, 0.0, np.pi / 2))
    >>> mapper.probabilities[0]
    array([[0. , 0.9, 0.9, 0.9, 0. ],
           [0. , 0.9, 0.9, 0.9, 0. ],
           [0. , 0.9, 0.9, 0.9, 0. ],
           [0. , 0. , 0. , 0. , 0. ],
           [0. , 0. , 0. , 0. , 0. ]], dtype=float32)
    """

    def __init__(self, grid: Grid, ego: EgoGrid, categories: Sequence[str], rule: UpdateRule) -> None:
        if not categories:
            raise UserError("categories: got none, expected the name of at least one layer")
        if not np.isclose(ego.resolution, grid.resolution, rtol=1e-6, atol=0):
            raise UserError(
                f"resolution: got {ego.resolution} m for views, {grid.resolution} m for the map, expected equal values"
            )
        _check_size(len(categories), grid)
        self.grid, self.ego, self.categories, self.rule = grid, ego, list(categories), rule
        side = int(np.ceil(np.sqrt(2) * ego.cells)) + 1  # window of a view rotated by 45 degrees
        max_cells = len(categories) * side * side
        self._touched = (  # buffers of `register`
            np.empty(max_cells, np.int64),  # flat indices of the cells that a view writes
            np.empty(max_cells, np.float32),  # values in the view
            np.empty(max_cells, np.float32),  # values in the map
            np.empty(max_cells, np.int32),  # counts, see BYTES_PER_CELL
            np.empty(max_cells, np.bool_),  # imagined by the view without being observed
        )
        self.reset()

    def reset(self) -> None:
        """Clear the map."""
        self._probabilities, self._count = _blank(len(self.categories), self.grid)

    @property
    def probabilities(self) -> Float32[np.ndarray, "c h w"]:
        """Probabilities of the map, not copied; 0 in cells that no view has written."""
        return self._probabilities

    @property
    def written(self) -> Bool[np.ndarray, "c h w"]:
        """Mask of the cells that a view has written."""
        written: np.ndarray = np.not_equal(self._count, 0)
        return written

    def register(
        self,
        values: Float32[np.ndarray, "c v v"],
        mask: Bool[np.ndarray, "c v v"],
        pose: Pose,
        imagined: Bool[np.ndarray, "c v v"] | None = None,
    ) -> None:
        """Fuse one view into the map.

        Args:
            values: probabilities, 0 to 1.
            mask: cells that the view has evidence for; other cells do not change.
            pose: pose of the robot when the view was taken.
            imagined: cells that the view imagined without observing them; None if it observed all of `mask`.

        Raises:
            UserError: if a shape or type is wrong, values are not in [0, 1], or the pose is not finite. The map does
                not change.
        """
        imagined = np.zeros_like(mask) if imagined is None else imagined
        self._check(values, mask, imagined)
        to_grid = ego_to_grid(self.ego, self.grid, pose)
        window = _window(to_grid, self.ego, self.grid)
        layers = self._probabilities.reshape(-1), self._count.reshape(-1)
        to_ego = cv2.invertAffineTransform(to_grid)
        n = _gather(values, mask, imagined, to_ego, window, self.grid.shape, *layers, *self._touched)
        touched, new, old, count, only_imagined = (array[:n] for array in self._touched)
        _scatter(*layers, touched, new, self.rule(old, new, np.abs(count)), only_imagined)

    def cover(self, pose: Pose) -> None:
        """Extend the map by whole chunks until it contains every cell that a view from `pose` may reach.

        Raises:
            UserError: if the map would be too large, or the pose is not finite. The map does not change.
        """
        low, high = _reach(ego_to_grid(self.ego, self.grid, pose), self.ego)
        top, left = (max(0, -int(np.floor(index / CHUNK)) * CHUNK) for index in low)
        beyond = high - np.array(self.grid.shape) + 1
        bottom, right = (max(0, int(np.ceil(cells / CHUNK)) * CHUNK) for cells in beyond)
        if not (top or bottom or left or right):
            return
        rows, columns = self.grid.rows + top + bottom, self.grid.columns + left + right
        x, y = self.grid.origin
        resolution = self.grid.resolution
        grid = Grid(resolution, rows, columns, (x - left * resolution, y - bottom * resolution))
        _check_size(len(self.categories), grid)
        probabilities, count = _blank(len(self.categories), grid)
        inside = np.s_[:, top : rows - bottom, left : columns - right]
        probabilities[inside], count[inside] = self._probabilities, self._count
        self.grid, self._probabilities, self._count = grid, probabilities, count

    def outside(self, mask: Bool[np.ndarray, "c v v"], pose: Pose) -> int:
        """Count the cells with evidence that are outside the map; evidence in several layers of a cell counts once."""
        to_grid = ego_to_grid(self.ego, self.grid, pose)
        low, high = _reach(to_grid, self.ego)
        if (low >= 0).all() and (high < self.grid.shape).all():
            return 0
        cells = np.argwhere(mask.any(axis=0)) @ to_grid[:, :2].T + to_grid[:, 2]
        return len(cells) - int(self.grid.inside(np.floor(cells + 0.5).astype(np.int64)).sum())

    def write(self, layer: int, values: Float32[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]) -> None:
        """Initialize a layer with known values, as if one view had written them.

        Raises:
            UserError: if the shape of an array differs from that of the grid.
        """
        if values.shape != self.grid.shape or known.shape != self.grid.shape:
            raise UserError(f"layer: got shapes {values.shape} and {known.shape}, expected {self.grid.shape}")
        self._probabilities[layer] = np.where(known, values, np.float32(0))
        self._count[layer] = known

    def _check(self, values: np.ndarray, mask: np.ndarray, imagined: np.ndarray) -> None:
        """Check shapes and types of the arrays and the range of the values."""
        shape = len(self.categories), self.ego.cells, self.ego.cells
        arrays = (("values", values, np.float32), ("mask", mask, np.bool_), ("imagined", imagined, np.bool_))
        for name, array, dtype in arrays:
            if array.shape != shape or array.dtype != dtype:
                expected = np.dtype(dtype).name
                raise UserError(
                    f"{name}: got {array.dtype} of shape {array.shape}, expected {expected} of shape {shape}"
                )
        low, high = values.min(), values.max()
        if not (low >= 0 and high <= 1):  # also refuses NaN, which compares false
            raise UserError(
                f"values: got {low} to {high}, expected probabilities in [0, 1]; apply the sigmoid first"
            )


def physical_memory() -> int:
    """Return the physical memory of this machine, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _blank(layers: int, grid: Grid) -> tuple[Float32[np.ndarray, "c h w"], Int32[np.ndarray, "c h w"]]:
    """Return the probabilities and counts of an empty map."""
    shape = layers, *grid.shape
    return np.zeros(shape, np.float32), np.zeros(shape, np.int32)


def _check_size(layers: int, grid: Grid) -> None:
    needed = grid.rows * grid.columns * (layers * BYTES_PER_CELL + SAVING_BYTES_PER_CELL)
    available = physical_memory()
    if max(grid.shape) > MAX_CELLS:
        raise UserError(
            f"map: got {grid.rows} x {grid.columns} cells, expected at most {MAX_CELLS} a side; "
            "check the poses, or use a coarser resolution or a smaller extent"
        )
    if needed > available:
        raise UserError(
            f"map of {layers} x {grid.rows} x {grid.columns} cells: got {needed / 1e9:.1f} GB, expected "
            f"at most this machine's {available / 1e9:.1f} GB; use a coarser resolution or a smaller extent"
        )


def _reach(
    to_grid: Float64[np.ndarray, "2 3"], ego: EgoGrid
) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
    """Return the lowest and highest (row, column) in the global map of the cells whose centres a view may cover."""
    low, high = -0.5, ego.cells - 0.5
    corners = to_grid @ np.array([[low, low, high, high], [low, high, low, high], [1.0, 1.0, 1.0, 1.0]])
    return np.ceil(corners.min(axis=1)), np.floor(corners.max(axis=1))


def _window(to_grid: Float64[np.ndarray, "2 3"], ego: EgoGrid, grid: Grid) -> tuple[int, int, int, int]:
    """Return the first and last row and the first and last column of `_reach`, clipped to the map."""
    low, high = _reach(to_grid, ego)
    first = np.clip(low, 0, grid.shape)
    last = np.clip(high, -1, np.array(grid.shape) - 1)
    return int(first[0]), int(last[0]), int(first[1]), int(last[1])


@compiled
def _gather(
    values: Float32[np.ndarray, "c v v"],
    mask: Bool[np.ndarray, "c v v"],
    imagined: Bool[np.ndarray, "c v v"],
    to_ego: Float64[np.ndarray, "2 3"],
    window: tuple[int, int, int, int],
    shape: tuple[int, int],
    probabilities: Float32[np.ndarray, " m"],
    counts: Int32[np.ndarray, " m"],
    touched: Int64[np.ndarray, " n"],
    new: Float32[np.ndarray, " n"],
    old: Float32[np.ndarray, " n"],
    count: Int32[np.ndarray, " n"],
    only_imagined: Bool[np.ndarray, " n"],
) -> int:
    """Gather the cells that a view writes into the last five arguments, and return their number.

    Masks are sampled by nearest neighbour, values by bilinear interpolation, with edge values repeated beyond the
    border.
    """
    layers, last = values.shape[0], values.shape[1] - 1
    n = 0
    for row in range(window[0], window[1] + 1):
        for column in range(window[2], window[3] + 1):
            r = to_ego[0, 0] * row + to_ego[0, 1] * column + to_ego[0, 2]
            c = to_ego[1, 0] * row + to_ego[1, 1] * column + to_ego[1, 2]
            if not (-0.5 <= r < last + 0.5 and -0.5 <= c < last + 0.5):
                continue
            nearest_r, nearest_c = int(r + 0.5), int(c + 0.5)
            inside_r, inside_c = min(max(r, 0.0), float(last)), min(max(c, 0.0), float(last))
            up, left = int(inside_r), int(inside_c)
            down, right = min(up + 1, last), min(left + 1, last)
            down_weight, right_weight = np.float32(inside_r - up), np.float32(inside_c - left)
            for k in range(layers):
                if mask[k, nearest_r, nearest_c]:
                    upper = values[k, up, left] + right_weight * (values[k, up, right] - values[k, up, left])
                    lower = values[k, down, left] + right_weight * (
                        values[k, down, right] - values[k, down, left]
                    )
                    cell = (k * shape[0] + row) * shape[1] + column
                    touched[n], old[n], count[n] = cell, probabilities[cell], counts[cell]
                    new[n] = upper + down_weight * (lower - upper)
                    only_imagined[n] = imagined[k, nearest_r, nearest_c]
                    n += 1
    return n


@compiled
def _scatter(
    probabilities: Float32[np.ndarray, " m"],
    counts: Int32[np.ndarray, " m"],
    touched: Int64[np.ndarray, " n"],
    new: Float32[np.ndarray, " n"],
    merged: Float32[np.ndarray, " n"],
    only_imagined: Bool[np.ndarray, " n"],
) -> None:
    """Write merged values (new values where the cell is first written or first observed) and update the counts."""
    for n in range(touched.size):
        cell = np.uint64(touched[n])  # unsigned, so that numba does not handle negative indices
        count = counts[cell]
        first_observation = not only_imagined[n] and count <= 0
        probabilities[cell] = new[n] if first_observation or count == 0 else merged[n]
        if first_observation:
            counts[cell] = 1
        else:
            counts[cell] = count + 1 if count > 0 else count - 1
