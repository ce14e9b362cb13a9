"""Grids that map array cells to metric positions (docs/concepts/conventions.md).

Arrays are indexed [row, column]. Global maps have row 0 at the largest y, as nav2's map_server stores them, and columns
grow with x. In egocentric maps the robot is at the centre of the middle cell of the last row and faces up.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from imagination.geometry.pose import Pose
from imagination.utils.errors import UserError, check_range

MAX_CELLS = 20_001
"""Maximum side of a map, cells: one float32 layer of this size takes 1.6 GB."""


def cells_of(extent: float, resolution: float) -> int:
    """Return the side of a square map in cells: the odd number 2 floor(extent / (2 resolution)) + 1 (settled reading).

    Args:
        extent: side of the map, metres.
        resolution: side of a cell, metres.

    Raises:
        UserError: if an argument is out of range, or the map has more than MAX_CELLS cells a side.
    """
    check_range("resolution", resolution, 0.005, 1.0, "m")
    check_range("extent", extent, 3 * resolution, 10_000, "m")
    # the tolerance keeps exact ratios such as 5.22 / 0.04 from rounding below their integer in floating point
    cells = 2 * int(np.floor(extent / (2 * resolution) + 1e-6)) + 1
    if cells > MAX_CELLS:
        raise UserError(
            f"map of {extent} m at {resolution} m: got {cells} cells a side, expected at most {MAX_CELLS}; "
            "use a coarser resolution or a smaller extent"
        )
    return cells


@dataclass(frozen=True)
class Grid:
    """Grid of a global map.

    Attributes:
        resolution: side of a cell, metres.
        rows, columns: shape of the arrays.
        origin: world x, y of the lower-left corner of the map (a corner of cell [rows - 1, 0]), metres.
    """

    resolution: float
    rows: int
    columns: int
    origin: tuple[float, float]

    @classmethod
    def centred(cls, extent: float, resolution: float, centre: tuple[float, float] = (0.0, 0.0)) -> "Grid":
        """Return a square grid with an odd number of cells a side, its middle cell centred on `centre`."""
        cells = cells_of(extent, resolution)
        half = cells * resolution / 2
        return cls(resolution, cells, cells, (centre[0] - half, centre[1] - half))

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    def to_cells(self, points: Float[np.ndarray, "*n 2"]) -> Int[np.ndarray, "*n 2"]:
        """Return the row and column of the cell of each world point; they may be outside the array."""
        column = np.floor((points[..., 0] - self.origin[0]) / self.resolution)
        row = self.rows - 1 - np.floor((points[..., 1] - self.origin[1]) / self.resolution)
        return np.stack([row, column], axis=-1).astype(np.int64)

    def to_points(self, cells: Int[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Return the world x, y of the centre of each cell, metres."""
        x = self.origin[0] + (cells[..., 1] + 0.5) * self.resolution
        y = self.origin[1] + (self.rows - cells[..., 0] - 0.5) * self.resolution
        return np.stack([x, y], axis=-1)

    def inside(self, cells: Int[np.ndarray, "*n 2"]) -> np.ndarray:
        """Return the mask of the cells that are inside the array."""
        mask: np.ndarray = np.all((cells >= 0) & (cells < np.array(self.shape)), axis=-1)
        return mask


@dataclass(frozen=True)
class EgoGrid:
    """Grid of an egocentric map: `cells` x `cells`, the robot at the centre of cell [cells - 1, cells // 2], facing up.

    A point x metres ahead and y metres to the left has the continuous row cells - 1 - x / resolution and the continuous
    column cells // 2 - y / resolution.

    Attributes:
        resolution: side of a cell, metres.
        cells: side of the map, cells.
    """

    resolution: float
    cells: int

    @classmethod
    def of_extent(cls, extent: float, resolution: float) -> "EgoGrid":
        """Return a grid with `cells_of(extent, resolution)` cells a side."""
        return cls(resolution, cells_of(extent, resolution))

    def to_cells(self, points: Float[np.ndarray, "*n 2"]) -> Int[np.ndarray, "*n 2"]:
        """Return the row and column of points in the robot frame (x forward, y left; metres); they may be outside."""
        row = np.floor(self.cells - 0.5 - points[..., 0] / self.resolution)
        column = np.floor(self.cells // 2 + 0.5 - points[..., 1] / self.resolution)
        return np.stack([row, column], axis=-1).astype(np.int64)

    def to_points(self, cells: Int[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Return the centre of each cell in the robot frame (x forward, y left), metres."""
        forward = (self.cells - 1 - cells[..., 0]) * self.resolution
        left = (self.cells // 2 - cells[..., 1]) * self.resolution
        return np.stack([forward, left], axis=-1)

    def centres(self, pose: Pose) -> Float[np.ndarray, "v v 2"]:
        """Return the world x, y of the centre of every cell for a robot at `pose`, metres."""
        return pose.to_world(self.to_points(np.moveaxis(np.indices((self.cells, self.cells)), 0, -1)))
