"""Where chairs go at a designed table, and where smaller things stand on furniture: read from its mesh."""

import numpy as np
from jaxtyping import Bool, Float, Float32

from imagination.geometry.grid import Grid
from imagination.scenes.building_blocks.pieces import Seat, Surface
from imagination.scenes.free_space import cells_below

CELL = 0.02
"""Side of the cells in which room for knees is looked for, metres."""
PLACE = 0.58
"""Length of table edge that one diner takes, metres."""
KNEES = 0.22
"""Half the width that must be free of legs for a chair to go in, metres."""
REACH = 0.12
"""Least depth that a chair must go in, metres."""
ROUND = 0.25
"""Farthest that an edge may lie inside the box around the table, metres."""
YAWS = (np.pi, np.pi / 2, 0.0, -np.pi / 2)
"""Of chairs before the front, the right, the back and the left side."""

SEATED = ("dining_table", "desk")
TOPPED = (*SEATED, "coffee_table", "side_table", "nightstand", "dresser", "sideboard")


def seats_and_surfaces(
    label: str, corners: Float32[np.ndarray, "m 3 3"]
) -> tuple[tuple[Seat, ...], tuple[Surface, ...]]:
    """Places for chairs and for smaller things, in the piece's frame.

    Args:
        label: of the piece; only tables have seats.
        corners: of its triangles, metres.
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
    """Height of the level surface with the largest area above a third of the piece's height, metres."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area, z = np.linalg.norm(normal, axis=1) / 2, corners[..., 2].mean(axis=1)
    height = float(corners[..., 2].max())
    level = (np.abs(normal[:, 2]) > 0.95 * 2 * area) & (z > height / 3)
    if not level.any():
        return height
    bins = np.round(z[level] / 0.01).astype(int)
    areas = np.bincount(bins, weights=area[level])
    most = int(areas.argmax())
    near = np.flatnonzero(areas[most : most + 8] > 0.3 * areas[most])  # underside and top are alike
    return float((most + near.max()) * 0.01)


def _surface(label: str, corners: Float32[np.ndarray, "m 3 3"], top: float) -> Surface:
    """A level rectangle on the top; of no depth where something stands on it already."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    middle, half = (low + high) / 2, (high - low) / 2
    share_x, share_y = (0.9, 0.8) if label == "desk" else (0.68, 0.68)
    if high[2] > top + 0.05:
        share_y = 0.0
    reach_x, reach_y = half[0] * share_x, half[1] * share_y
    x0, y0, x1, y1 = middle[0] - reach_x, middle[1] - reach_y, middle[0] + reach_x, middle[1] + reach_y
    return Surface(float(x0), float(y0), float(x1), float(y1), top)


class _Table:
    """Top and legs of a table in cells.

    Args:
        corners: of its triangles, metres.
        top: height of its surface, metres.
    """

    def __init__(self, corners: Float32[np.ndarray, "m 3 3"], top: float) -> None:
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        z = corners[..., 2]
        hanging = z[(z > 0.6 * top) & (z < top - 0.005)]  # the top's underside, its frame, drawers
        self.underside = float(hanging.min()) if hanging.size else top - 0.03
        rows, columns = (np.ceil((high - low)[[1, 0]] / CELL).astype(int) + 1).tolist()
        grid = Grid(CELL, rows, columns, (float(low[0]) - CELL / 2, float(low[1]) - CELL / 2))
        self.top = cells_below(corners, grid, self.underside - 0.005, top + 0.01)
        self.legs = cells_below(corners, grid, 0.06, self.underside - 0.02)
        self.places = grid.to_points(np.moveaxis(np.indices(grid.shape), 0, -1))

    def along(self, side: int) -> list[Seat]:
        """Places along the front (0), right (1), back (2) or left side (3), as many as there is room for."""
        length = np.rot90(self.top, side).shape[1] * CELL
        count = int(length / PLACE)
        shares = (np.arange(count) + 0.5) / max(count, 1)
        seats = [self._seat(side, float(share) * length, length / count) for share in shares]
        return [seat for seat in seats if seat is not None and seat.depth >= REACH]

    def best_in_front(self) -> Seat:
        """The deepest place at the front, the one next to the middle among equals."""
        length = self.top.shape[1] * CELL
        tried = [
            self._seat(0, place, 2 * KNEES + 0.2) for place in np.arange(KNEES, length - KNEES + 0.01, 0.05)
        ]
        x, y = self.places[0].mean(axis=0).tolist()
        next_to = Seat(x, y, YAWS[0], 2 * KNEES + 0.2, 0.0, self.underside)  # a chair may stand before it
        found = [seat for seat in tried if seat is not None] or [next_to]
        return max(found, key=lambda seat: (round(seat.depth, 1), -abs(seat.x - x)))

    def _seat(self, side: int, along: float, width: float) -> Seat | None:
        """A place at a distance along a side; None where the table has no edge to sit at."""
        top, legs = np.rot90(self.top, side), np.rot90(self.legs, side)
        places = np.rot90(self.places, side)
        column = min(int(along / CELL), top.shape[1] - 1)
        edge = _first(_strip(top, column, 0.1))
        if edge is None or edge * CELL > ROUND:
            return None
        blocked = _first(_strip(legs, column, KNEES))
        limit = min(top.shape[0] // 2, top.shape[0] if blocked is None else blocked)
        depth = max(limit - edge, 0) * CELL - 0.03
        if depth < 0:
            return None
        inward = np.array([-np.sin(YAWS[side]), np.cos(YAWS[side])])
        x, y = (places[edge, column] - inward * CELL / 2).tolist()
        return Seat(x, y, YAWS[side], width, depth, self.underside)


def _strip(cells: Bool[np.ndarray, "h w"], column: int, half: float) -> Bool[np.ndarray, " h"]:
    """Rows with a cell within `half` metres of a column."""
    reach = int(round(half / CELL))
    rows: np.ndarray = cells[:, max(column - reach, 0) : column + reach + 1].any(axis=1)
    return rows


def _first(rows: Bool[np.ndarray, " h"]) -> int | None:
    return int(rows.argmax()) if rows.any() else None


def corners_of(vertices: Float[np.ndarray, "n 3"], faces: np.ndarray) -> Float32[np.ndarray, "m 3 3"]:
    """The corners of each triangle."""
    corners: np.ndarray = np.asarray(vertices, np.float32)[faces]
    return corners
