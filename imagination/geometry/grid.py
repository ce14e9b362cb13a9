"""Grids: which cell of an array is which place (docs/conventions.md).

Arrays are indexed [row, column]. Global maps have row 0 at the largest y, as nav2's map_server stores them, and the
column grows with x. Egocentric maps have the robot at the centre of the middle cell of the last row, looking up.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from imagination.geometry.pose import Pose
from imagination.utils.errors import UserError, check_range

MAX_CELLS = 20_001
"""Cells a side that a map may have: beyond, one layer alone takes 1.6 GB as float32."""


def cells_of(extent: float, resolution: float) -> int:
    """Cells a side of a square map: the odd number 2 floor(extent / (2 resolution)) + 1 (settled reading).

    Args:
        extent: side of the map, metres.
        resolution: side of a cell, metres.

    Raises:
        UserError: if either is out of range or the map would not fit in memory.
    """
    check_range("resolution", resolution, 0.005, 1.0, "m")
    check_range("extent", extent, 3 * resolution, 10_000, "m")
    # the small term keeps exact ratios such as 5.22 / 0.04 from falling below their integer in floating point
    cells = 2 * int(np.floor(extent / (2 * resolution) + 1e-6)) + 1
    if cells > MAX_CELLS:
        raise UserError(
            f"map of {extent} m at {resolution} m: got {cells} cells a side, expected at most {MAX_CELLS}; "
            "choose a coarser resolution or a smaller extent"
        )
    return cells


@dataclass(frozen=True)
class Grid:
    """A global map's grid.

    Attributes:
        resolution: metres per cell.
        rows, columns: size of the arrays.
        origin: world x, y of the lower-left corner of the map (the corner of cell [rows - 1, 0]), metres.
    """

    resolution: float
    rows: int
    columns: int
    origin: tuple[float, float]

    @classmethod
    def centred(cls, extent: float, resolution: float, centre: tuple[float, float] = (0.0, 0.0)) -> "Grid":
        """Square grid with an odd number of cells a side whose middle cell's centre lies on `centre`."""
        cells = cells_of(extent, resolution)
        half = cells * resolution / 2
        return cls(resolution, cells, cells, (centre[0] - half, centre[1] - half))

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    def to_cells(self, points: Float[np.ndarray, "*n 2"]) -> Int[np.ndarray, "*n 2"]:
        """Row and column of the cell each world point lies in; may lie outside the array."""
        column = np.floor((points[..., 0] - self.origin[0]) / self.resolution)
        row = self.rows - 1 - np.floor((points[..., 1] - self.origin[1]) / self.resolution)
        return np.stack([row, column], axis=-1).astype(np.int64)

    def to_points(self, cells: Int[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """World x, y of the centre of each cell, metres."""
        x = self.origin[0] + (cells[..., 1] + 0.5) * self.resolution
        y = self.origin[1] + (self.rows - cells[..., 0] - 0.5) * self.resolution
        return np.stack([x, y], axis=-1)

    def inside(self, cells: Int[np.ndarray, "*n 2"]) -> np.ndarray:
        """Which cells lie in the array."""
        within: np.ndarray = np.all((cells >= 0) & (cells < np.array(self.shape)), axis=-1)
        return within


@dataclass(frozen=True)
class EgoGrid:
    """An egocentric map's grid: `cells` x `cells`, the robot at the centre of cell [cells - 1, cells // 2], looking up.

    A point x metres ahead and y metres to the left lies around row cells - 1 - x / resolution and column
    cells // 2 - y / resolution.
    """

    resolution: float
    cells: int

    @classmethod
    def of_extent(cls, extent: float, resolution: float) -> "EgoGrid":
        """Grid with the cells of `cells_of(extent, resolution)`."""
        return cls(resolution, cells_of(extent, resolution))

    def to_cells(self, points: Float[np.ndarray, "*n 2"]) -> Int[np.ndarray, "*n 2"]:
        """Row and column of each point given in the robot's frame (x forward, y left; metres); may lie outside."""
        row = np.floor(self.cells - 0.5 - points[..., 0] / self.resolution)
        column = np.floor(self.cells // 2 + 0.5 - points[..., 1] / self.resolution)
        return np.stack([row, column], axis=-1).astype(np.int64)

    def to_points(self, cells: Int[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Centre of each cell in the robot's frame (x forward, y left), metres."""
        forward = (self.cells - 1 - cells[..., 0]) * self.resolution
        left = (self.cells // 2 - cells[..., 1]) * self.resolution
        return np.stack([forward, left], axis=-1)

    def centres(self, pose: Pose) -> Float[np.ndarray, "v v 2"]:
        """World x, y of every cell's centre, for the robot at `pose`."""
        return pose.to_world(self.to_points(np.moveaxis(np.indices((self.cells, self.cells)), 0, -1)))
