"""The mapper: egocentric views registered into a global map with known poses (docs/conventions.md)."""

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
"""A probability (float32) and the number of views that wrote the cell (int32), negative while it was only imagined."""

SAVING_BYTES_PER_CELL = 64
"""Of the grid, whatever the layers: saving draws the map as a picture of floats, of which four are there at once."""

CHUNK = 128
"""Cells by which a map grows at a time."""


class Mapper:
    """A global map of probabilities, one layer for each category, that grows by registered views.

    The first view that writes a cell is taken whole, and so is the first that sees one which was only imagined before:
    by the rule alone, a wrong guess would outweigh what is seen afterwards (docs/conventions.md has the figures).

    A view changes only the cells of its own window, pulled by inverse mapping (values bilinear, masks nearest), so
    its cost depends on the egocentric map's size, never on the global map's.

    Args:
        grid: of the global map.
        ego: grid of the views; of the same resolution.
        categories: names of the layers.
        rule: what becomes of cells that were written before.

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
                f"resolution: got {ego.resolution} m for views, {grid.resolution} m for the map, expected one for both"
            )
        _check_size(len(categories), grid)
        self.grid, self.ego, self.categories, self.rule = grid, ego, list(categories), rule
        side = int(np.ceil(np.sqrt(2) * ego.cells)) + 1  # of the window of a view turned by 45 degrees
        most = len(categories) * side * side
        self._touched = (
            np.empty(most, np.int64),  # flat index of each cell that a view touches
            np.empty(most, np.float32),  # its value in the view
            np.empty(most, np.float32),  # its value in the map
            np.empty(most, np.int32),  # its count, see BYTES_PER_CELL
            np.empty(most, np.bool_),  # the view imagines it, without seeing it
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._probabilities, self._count = _blank(len(self.categories), self.grid)

    @property
    def probabilities(self) -> Float32[np.ndarray, "c h w"]:
        """The map itself, not a copy; 0 where nothing was written."""
        return self._probabilities

    @property
    def written(self) -> Bool[np.ndarray, "c h w"]:
        """Cells that a view has written."""
        written: np.ndarray = np.not_equal(self._count, 0)
        return written

    def register(
        self,
        values: Float32[np.ndarray, "c v v"],
        mask: Bool[np.ndarray, "c v v"],
        pose: Pose,
        imagined: Bool[np.ndarray, "c v v"] | None = None,
    ) -> None:
        """Let one view have its say.

        Args:
            values: probabilities, 0 to 1.
            mask: cells about which the view has something to say; others stay as they are.
            pose: of the robot, from which the view was taken.
            imagined: cells that the view has not seen; None if it saw all of `mask`.

        Raises:
            UserError: on wrong shapes or types, values that are not probabilities, or a pose that is not finite. The
                map stays as it was.
        """
        imagined = np.zeros_like(mask) if imagined is None else imagined
        self._check(values, mask, imagined)
        to_grid = ego_to_grid(self.ego, self.grid, pose)
        window = _window(to_grid, self.ego, self.grid)
        layers = self._probabilities.reshape(-1), self._count.reshape(-1)
        to_ego = cv2.invertAffineTransform(to_grid)
        n = _pull(values, mask, imagined, to_ego, window, self.grid.shape, *layers, *self._touched)
        touched, new, old, count, guessed = (array[:n] for array in self._touched)
        _push(*layers, touched, new, self.rule(old, new, np.abs(count)), guessed)

    def cover(self, pose: Pose) -> None:
        """Let the map grow, by whole chunks, until it contains all that a view from `pose` may reach.

        Raises:
            UserError: if it would be too large, or the pose is not finite. The map stays as it was.
        """
        low, high = _reach(ego_to_grid(self.ego, self.grid, pose), self.ego)
        top, left = (max(0, -int(np.floor(side / CHUNK)) * CHUNK) for side in low)
        beyond = high - np.array(self.grid.shape) + 1
        bottom, right = (max(0, int(np.ceil(side / CHUNK)) * CHUNK) for side in beyond)
        if not (top or bottom or left or right):
            return
        rows, columns = self.grid.rows + top + bottom, self.grid.columns + left + right
        x, y = self.grid.origin
        size = self.grid.resolution
        grid = Grid(size, rows, columns, (x - left * size, y - bottom * size))
        _check_size(len(self.categories), grid)
        probabilities, count = _blank(len(self.categories), grid)
        inside = np.s_[:, top : rows - bottom, left : columns - right]
        probabilities[inside], count[inside] = self._probabilities, self._count
        self.grid, self._probabilities, self._count = grid, probabilities, count

    def outside(self, mask: Bool[np.ndarray, "c v v"], pose: Pose) -> int:
        """How many of a view's cells with something to say, counted once for all layers, lie outside the map."""
        to_grid = ego_to_grid(self.ego, self.grid, pose)
        low, high = _reach(to_grid, self.ego)
        if (low >= 0).all() and (high < self.grid.shape).all():
            return 0
        cells = np.argwhere(mask.any(axis=0)) @ to_grid[:, :2].T + to_grid[:, 2]
        return len(cells) - int(self.grid.inside(np.floor(cells + 0.5).astype(np.int64)).sum())

    def write(self, layer: int, values: Float32[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]) -> None:
        """Start a layer from values that are known already, as if one view had written them.

        Raises:
            UserError: if the arrays have another shape than the grid.
        """
        if values.shape != self.grid.shape or known.shape != self.grid.shape:
            raise UserError(f"layer: got shapes {values.shape} and {known.shape}, expected {self.grid.shape}")
        self._probabilities[layer] = np.where(known, values, np.float32(0))
        self._count[layer] = known

    def _check(self, values: np.ndarray, mask: np.ndarray, imagined: np.ndarray) -> None:
        shape = len(self.categories), self.ego.cells, self.ego.cells
        given = (("values", values, np.float32), ("mask", mask, np.bool_), ("imagined", imagined, np.bool_))
        for name, array, dtype in given:
            if array.shape != shape or array.dtype != dtype:
                wanted = np.dtype(dtype).name
                raise UserError(
                    f"{name}: got {array.dtype} of shape {array.shape}, expected {wanted} of shape {shape}"
                )
        low, high = values.min(), values.max()
        if not (low >= 0 and high <= 1):  # NaN compares false, so it is refused too
            raise UserError(
                f"values: got {low} to {high}, expected probabilities, 0 to 1; apply the sigmoid before"
            )


def physical_memory() -> int:
    """Memory of this machine, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _blank(layers: int, grid: Grid) -> tuple[Float32[np.ndarray, "c h w"], Int32[np.ndarray, "c h w"]]:
    """A map to which nothing was written: probabilities and counts."""
    shape = layers, *grid.shape
    return np.zeros(shape, np.float32), np.zeros(shape, np.int32)


def _check_size(layers: int, grid: Grid) -> None:
    needed = grid.rows * grid.columns * (layers * BYTES_PER_CELL + SAVING_BYTES_PER_CELL)
    there = physical_memory()
    if max(grid.shape) > MAX_CELLS:
        raise UserError(
            f"map: got {grid.rows} x {grid.columns} cells, expected at most {MAX_CELLS} a side; "
            "check the poses, or choose a coarser resolution or a smaller extent"
        )
    if needed > there:
        raise UserError(
            f"map of {layers} x {grid.rows} x {grid.columns} cells: got {needed / 1e9:.1f} GB, expected "
            f"at most this machine's {there / 1e9:.1f} GB; choose a coarser resolution or a smaller extent"
        )


def _reach(
    to_grid: Float64[np.ndarray, "2 3"], ego: EgoGrid
) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
    """Lowest and highest global row and column of cells whose centres a view may cover."""
    low, high = -0.5, ego.cells - 0.5
    corners = to_grid @ np.array([[low, low, high, high], [low, high, low, high], [1.0, 1.0, 1.0, 1.0]])
    return np.ceil(corners.min(axis=1)), np.floor(corners.max(axis=1))


def _window(to_grid: Float64[np.ndarray, "2 3"], ego: EgoGrid, grid: Grid) -> tuple[int, int, int, int]:
    """First and last row, first and last column of the global cells whose centres a view may cover."""
    low, high = _reach(to_grid, ego)
    first = np.clip(low, 0, grid.shape)
    last = np.clip(high, -1, np.array(grid.shape) - 1)
    return int(first[0]), int(last[0]), int(first[1]), int(last[1])


@compiled
def _pull(
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
    guessed: Bool[np.ndarray, " n"],
) -> int:
    """List the cells that the view touches: index, value in the view, in the map, count, unseen; returns how many.

    The mask comes from the nearest egocentric cell, the value from the four nearest; beyond the rim the rim goes on.
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
            down_share, right_share = np.float32(inside_r - up), np.float32(inside_c - left)
            for k in range(layers):
                if mask[k, nearest_r, nearest_c]:
                    upper = values[k, up, left] + right_share * (values[k, up, right] - values[k, up, left])
                    lower = values[k, down, left] + right_share * (
                        values[k, down, right] - values[k, down, left]
                    )
                    cell = (k * shape[0] + row) * shape[1] + column
                    touched[n], old[n], count[n] = cell, probabilities[cell], counts[cell]
                    new[n] = upper + down_share * (lower - upper)
                    guessed[n] = imagined[k, nearest_r, nearest_c]
                    n += 1
    return n


@compiled
def _push(
    probabilities: Float32[np.ndarray, " m"],
    counts: Int32[np.ndarray, " m"],
    touched: Int64[np.ndarray, " n"],
    new: Float32[np.ndarray, " n"],
    merged: Float32[np.ndarray, " n"],
    guessed: Bool[np.ndarray, " n"],
) -> None:
    """Write merged values, or new ones whole where nothing was written, or only imagined and now seen; count."""
    for n in range(touched.size):
        cell = np.uint64(touched[n])  # unsigned: numba need not look for indices from the end
        count = counts[cell]
        first_sighting = not guessed[n] and count <= 0
        probabilities[cell] = new[n] if first_sighting or count == 0 else merged[n]
        if first_sighting:
            counts[cell] = 1
        else:
            counts[cell] = count + 1 if count > 0 else count - 1
