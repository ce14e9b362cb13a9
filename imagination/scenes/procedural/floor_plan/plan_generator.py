"""Random floor plans: cells along a corridor or in columns, with a room kind assigned to each cell."""

import numpy as np

from imagination.scenes.procedural.floor_plan.openings import draw_doors, draw_facade, wall_segments
from imagination.scenes.procedural.floor_plan.plan import OUTSIDE, WALL, Cell, Plan, Room, RoomKind
from imagination.utils.errors import UserError

AREA = (40.0, 150.0)
"""Minimum and maximum floor area of a home, square metres."""
ATTEMPTS = 200
"""Maximum number of attempts to draw a plan; about one in three is accepted."""

Rng = np.random.Generator


def draw_plan(rng: Rng) -> Plan:
    """Draw a plan with an area within AREA and doors to every room.

    Raises:
        UserError: if no attempt succeeds.
    """
    for _ in range(ATTEMPTS):
        area = float(np.exp(rng.uniform(np.log(AREA[0] * 1.15), np.log(AREA[1]))))
        corridor = rng.random() < 0.75
        cells = _along_corridor(rng, area) if corridor else _columns(rng, area)
        if min(min(cell.x1 - cell.x0, cell.y1 - cell.y0) for cell in cells) < (1.2 if corridor else 2.2):
            continue
        rooms = _rooms(rng, cells, corridor)
        if rooms is None or not AREA[0] <= sum(room.area for room in rooms) <= AREA[1]:
            continue
        doors = draw_doors(rng, cells, rooms)
        if doors is not None:
            openings = (*doors, *draw_facade(rng, cells, rooms))
            return Plan(tuple(rooms), openings, float(rng.uniform(2.45, 2.85)))
    raise UserError(f"floor plan: got no valid plan in {ATTEMPTS} attempts; use another seed")


def _cut(rng: Rng, start: float, end: float, typical: float) -> list[tuple[float, float]]:
    """Divide an interval into random pieces of about `typical` metres."""
    count = max(1, round((end - start) / typical))
    lengths = rng.uniform(0.72, 1.28, count).cumsum()
    edges = [start, *(start + (end - start) * lengths / lengths[-1])]
    return [(float(a), float(b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def _along_corridor(rng: Rng, area: float) -> list[Cell]:
    """Draw a corridor (the first cell) with a row of rooms on each side and living rooms across its end."""
    width, north = rng.uniform(1.25, 1.6), rng.uniform(2.9, 4.2)
    south = rng.uniform(2.9, 4.1) if area > 80 else rng.uniform(2.0, 2.7)
    depth = width + north + south
    length = area / depth
    slab = float(np.clip(length * rng.uniform(0.34, 0.46), 3.5, 6.3))
    cells = [Cell(slab, south, length, south + width)]
    cells += [Cell(a, 0, b, south) for a, b in _cut(rng, slab, length, rng.uniform(2.6, 3.6))]
    cells += [Cell(a, south + width, b, depth) for a, b in _cut(rng, slab, length, rng.uniform(2.9, 3.9))]
    # the living rooms may extend beyond the rows, which gives an L-shaped plan
    low, high = (-rng.uniform(0, 1.5), depth) if rng.random() < 0.5 else (0.0, depth + rng.uniform(0, 1.5))
    cells += [Cell(0, a, slab, b) for a, b in _cut(rng, low, high, rng.uniform(3.2, 6.0))]
    mirrored = rng.random() < 0.5
    return [Cell(-cell.x1, cell.y0, -cell.x0, cell.y1) for cell in cells] if mirrored else cells


def _columns(rng: Rng, area: float) -> list[Cell]:
    """Draw rooms in columns without a corridor."""
    length = float(np.sqrt(area * rng.uniform(0.9, 1.7)))
    depth = area / length
    return [
        Cell(x0, y0, x1, y1)
        for x0, x1 in _cut(rng, 0, length, rng.uniform(3.2, 4.6))
        for y0, y1 in _cut(rng, 0, depth, rng.uniform(3.0, 4.8))
    ]


ROOM_KINDS: tuple[tuple[RoomKind, ...], ...] = (
    ("bedroom",),
    ("bedroom", "kitchen"),
    ("bedroom", "kitchen", "bathroom"),
    ("bedroom", "office", "kitchen", "bathroom"),
    ("bedroom", "bedroom", "dining", "kitchen", "bathroom"),
    ("bedroom", "bedroom", "dining", "office", "kitchen", "bathroom"),
    ("bedroom", "bedroom", "dining", "bedroom", "office", "kitchen", "bathroom"),
    ("bedroom", "bedroom", "dining", "bedroom", "office", "kitchen", "bathroom", "bathroom"),
    ("bedroom", "bedroom", "dining", "bedroom", "office", "kitchen", "office", "bathroom", "bathroom"),
)
"""Kinds of the rooms other than living room and corridor, largest first, by their number."""


def _rooms(rng: Rng, cells: list[Cell], corridor: bool) -> list[Room] | None:
    """Assign a kind to each cell: draw several assignments and return the best by `_score`, or None."""
    half = WALL / 2
    empty = [Room("corridor", c.x0 + half, c.y0 + half, c.x1 - half, c.y1 - half) for c in cells]
    free = list(range(1 if corridor else 0, len(cells)))
    living = max(free, key=lambda number: empty[number].area)
    rest = sorted((number for number in free if number != living), key=lambda number: -empty[number].area)
    if not 1 <= len(rest) <= len(ROOM_KINDS) or empty[living].area < 11 or empty[rest[0]].area < 7.5:
        return None
    best, best_score = None, -np.inf
    for _ in range(10):
        # noise on the areas swaps rooms of similar size
        order = sorted(rest, key=lambda number: -empty[number].area * rng.uniform(0.8, 1.2))
        kinds: dict[int, RoomKind] = {living: "living"}
        kinds |= dict(zip(order, ROOM_KINDS[len(rest) - 1], strict=True))
        rooms = [Room(kinds.get(n, "corridor"), r.x0, r.y0, r.x1, r.y1) for n, r in enumerate(empty)]
        score = _score(cells, rooms)
        if score > best_score:
            best, best_score = rooms, score
    return best if best_score > 0 else None


def _score(cells: list[Cell], rooms: list[Room]) -> float:
    """Return a score of the room kinds; it is not positive if one is impossible."""
    score = 1.0
    for number, room in enumerate(rooms):
        adjacent = {
            rooms[s.other].kind for s in wall_segments(cells, number) if s.other != OUTSIDE and s.length > 1.4
        }
        if room.kind == "bedroom" and (room.area < 7.0 or min(room.size) < 2.3):
            score -= 100
        if room.kind in ("dining", "office", "kitchen") and min(room.size) < 1.9:
            score -= 100
        score += 2.0 * (
            room.kind in ("kitchen", "dining")
            and bool(adjacent & {"living", "dining", "kitchen"} - {room.kind})
        )
        score -= room.area / 10 * (room.kind in ("bathroom", "kitchen"))
        score += 1.0 * (room.kind == "bedroom" and "corridor" in adjacent)
    return score + 10
