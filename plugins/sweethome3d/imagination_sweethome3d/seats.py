"""Places for chairs at a table and for small objects on furniture, derived from the mesh."""

import numpy as np
from jaxtyping import Bool, Float, Float32

from imagination.geometry.grid import Grid
from imagination.scenes.building_blocks.pieces import Seat, Surface
from imagination.scenes.free_space import cells_below

CELL = 0.02
"""Side of the cells in which leg room is searched, metres."""
SEAT_WIDTH = 0.58
"""Length of table edge for one seat, metres."""
KNEE_HALF_WIDTH = 0.22
"""Half the width that must be free of table legs for a chair, metres."""
MIN_DEPTH = 0.12
"""Minimum depth of a chair under the table, metres."""
MAX_INSET = 0.25
"""Maximum distance of a table edge from the box around the table, metres."""
YAWS = (np.pi, np.pi / 2, 0.0, -np.pi / 2)
"""Yaw of chairs at the front, right, back and left side, radians."""

SEATED = ("dining_table", "desk")
TOPPED = (*SEATED, "coffee_table", "side_table", "nightstand", "dresser", "sideboard")


def seats_and_surfaces(
    label: str, corners: Float32[np.ndarray, "m 3 3"]
) -> tuple[tuple[Seat, ...], tuple[Surface, ...]]:
    """Return places for chairs and surfaces for small objects, in the frame of the piece.

    Args:
        label: label of the piece; only tables and desks have seats.
        corners: corners of the triangles, metres.
    """
    if label not in TOPPED:
        return (), ()
    top = top_height(corners)
    surfaces = (_surface(label, corners, top),)
    if label not in SEATED:
        return (), surfaces
    table = _Table(corners, top)
    if label == "desk":
        return (table.best_in_front(),), surfaces
    return tuple(seat for side in range(4) for seat in table.along(side)), surfaces


def top_height(corners: Float32[np.ndarray, "m 3 3"]) -> float:
    """Return the height of the largest horizontal surface above a third of the piece's height, metres."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area, z = np.linalg.norm(normal, axis=1) / 2, corners[..., 2].mean(axis=1)
    height = float(corners[..., 2].max())
    level = (np.abs(normal[:, 2]) > 0.95 * 2 * area) & (z > height / 3)
    if not level.any():
        return height
    bins = np.round(z[level] / 0.01).astype(int)
    areas = np.bincount(bins, weights=area[level])
    most = int(areas.argmax())
    # the underside may be as large as the top
    near = np.flatnonzero(areas[most : most + 8] > 0.3 * areas[most])
    return float((most + near.max()) * 0.01)


def _surface(label: str, corners: Float32[np.ndarray, "m 3 3"], top: float) -> Surface:
    """Return a horizontal rectangle on the top, of depth 0 if the mesh has objects on it."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    middle, half = (low + high) / 2, (high - low) / 2
    fraction_x, fraction_y = (0.9, 0.8) if label == "desk" else (0.68, 0.68)
    if high[2] > top + 0.05:
        fraction_y = 0.0
    reach_x, reach_y = half[0] * fraction_x, half[1] * fraction_y
    x0, y0, x1, y1 = middle[0] - reach_x, middle[1] - reach_y, middle[0] + reach_x, middle[1] + reach_y
    return Surface(float(x0), float(y0), float(x1), float(y1), top)


class _Table:
    """Occupancy grids of the top and the legs of a table.

    Args:
        corners: corners of the triangles, metres.
        top: height of the surface, metres.
    """

    def __init__(self, corners: Float32[np.ndarray, "m 3 3"], top: float) -> None:
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        z = corners[..., 2]
        hanging = z[(z > 0.6 * top) & (z < top - 0.005)]  # underside of the top, frame, drawers
        self.underside = float(hanging.min()) if hanging.size else top - 0.03
        rows, columns = (np.ceil((high - low)[[1, 0]] / CELL).astype(int) + 1).tolist()
        grid = Grid(CELL, rows, columns, (float(low[0]) - CELL / 2, float(low[1]) - CELL / 2))
        self.top = cells_below(corners, grid, self.underside - 0.005, top + 0.01)
        self.legs = cells_below(corners, grid, 0.06, self.underside - 0.02)
        self.points = grid.to_points(np.moveaxis(np.indices(grid.shape), 0, -1))

    def along(self, side: int) -> list[Seat]:
        """Return as many seats as fit along the front (0), right (1), back (2) or left side (3)."""
        length = np.rot90(self.top, side).shape[1] * CELL
        count = int(length / SEAT_WIDTH)
        fractions = (np.arange(count) + 0.5) / max(count, 1)
        seats = [self._seat(side, float(fraction) * length, length / count) for fraction in fractions]
        return [seat for seat in seats if seat is not None and seat.depth >= MIN_DEPTH]

    def best_in_front(self) -> Seat:
        """Return the deepest seat at the front, and among equally deep ones the one nearest to the middle."""
        length = self.top.shape[1] * CELL
        width = 2 * KNEE_HALF_WIDTH + 0.2
        positions = np.arange(KNEE_HALF_WIDTH, length - KNEE_HALF_WIDTH + 0.01, 0.05)
        seats = [seat for place in positions if (seat := self._seat(0, place, width)) is not None]
        x, y = self.points[0].mean(axis=0).tolist()
        in_front = Seat(x, y, YAWS[0], width, 0.0, self.underside)
        return max(seats or [in_front], key=lambda seat: (round(seat.depth, 1), -abs(seat.x - x)))

    def _seat(self, side: int, along: float, width: float) -> Seat | None:
        """Return the seat at a distance along a side, or None where the table has no edge."""
        top, legs = np.rot90(self.top, side), np.rot90(self.legs, side)
        points = np.rot90(self.points, side)
        column = min(int(along / CELL), top.shape[1] - 1)
        edge = _first(_strip(top, column, 0.1))
        if edge is None or edge * CELL > MAX_INSET:
            return None
        blocked = _first(_strip(legs, column, KNEE_HALF_WIDTH))
        limit = min(top.shape[0] // 2, top.shape[0] if blocked is None else blocked)
        depth = max(limit - edge, 0) * CELL - 0.03
        if depth < 0:
            return None
        inward = np.array([-np.sin(YAWS[side]), np.cos(YAWS[side])])
        x, y = (points[edge, column] - inward * CELL / 2).tolist()
        return Seat(x, y, YAWS[side], width, depth, self.underside)


def _strip(cells: Bool[np.ndarray, "h w"], column: int, half: float) -> Bool[np.ndarray, " h"]:
    """Return a mask of the rows with an occupied cell within `half` metres of a column."""
    reach = int(round(half / CELL))
    rows: np.ndarray = cells[:, max(column - reach, 0) : column + reach + 1].any(axis=1)
    return rows


def _first(rows: Bool[np.ndarray, " h"]) -> int | None:
    return int(rows.argmax()) if rows.any() else None


def corners_of(vertices: Float[np.ndarray, "n 3"], faces: np.ndarray) -> Float32[np.ndarray, "m 3 3"]:
    """Return the corners of each triangle."""
    corners: np.ndarray = np.asarray(vertices, np.float32)[faces]
    return corners
