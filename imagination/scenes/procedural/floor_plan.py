"""Floor plans: rooms side by side, what each is for, and the openings between them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from imagination.errors import UserError

RoomKind = Literal["living", "dining", "kitchen", "bedroom", "office", "bathroom", "corridor"]
OpeningKind = Literal["door", "passage", "window", "entrance"]

WALL = 0.12
"""Thickness of inner walls, metres."""
AREA = (40.0, 150.0)
"""Smallest and largest floor area of a home, square metres."""
ATTEMPTS = 200
"""Plans drawn before giving up; about one in three is accepted."""
OUTSIDE = -1

Rng = np.random.Generator


class Cell(NamedTuple):
    """A rectangle between the middles of its walls, metres."""

    x0: float
    y0: float
    x1: float
    y1: float


@dataclass(frozen=True)
class Room:
    """A rectangular room, between the surfaces of its walls, metres."""

    kind: RoomKind
    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def size(self) -> tuple[float, float]:
        return self.x1 - self.x0, self.y1 - self.y0

    @property
    def area(self) -> float:
        return self.size[0] * self.size[1]


@dataclass(frozen=True)
class Opening:
    """A hole in a wall.

    Attributes:
        kind: entrances are shut, windows show a bright pane.
        rooms: the rooms it joins, or a room and OUTSIDE.
        axis: 0 if the wall runs along x, 1 if along y.
        at: the other coordinate of the wall's middle.
        start, end: along the wall.
        low, high: heights above the floor.
    """

    kind: OpeningKind
    rooms: tuple[int, int]
    axis: int
    at: float
    start: float
    end: float
    low: float
    high: float

    @property
    def centre(self) -> tuple[float, float]:
        middle = (self.start + self.end) / 2
        return (middle, self.at) if self.axis == 0 else (self.at, middle)


@dataclass(frozen=True)
class Plan:
    """One floor."""

    rooms: tuple[Room, ...]
    openings: tuple[Opening, ...]
    ceiling: float

    @property
    def area(self) -> float:
        """Floor area of all rooms, square metres."""
        return sum(room.area for room in self.rooms)

    def openings_of(self, room: int) -> list[Opening]:
        """Openings in a room's walls."""
        return [opening for opening in self.openings if room in opening.rooms]


class Shared(NamedTuple):
    """A stretch of wall: axis 0 runs along x; `other` is the cell behind it, or OUTSIDE."""

    axis: int
    at: float
    start: float
    end: float
    other: int

    @property
    def length(self) -> float:
        return self.end - self.start


def draw_plan(rng: Rng) -> Plan:
    """A plan with an area within AREA in which every room can be reached.

    Raises:
        UserError: if none of ATTEMPTS draws gives one.
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
        doors = _doors(rng, cells, rooms)
        if doors is not None:
            openings = (*doors, *_facade(rng, cells, rooms))
            return Plan(tuple(rooms), openings, float(rng.uniform(2.45, 2.85)))
    raise UserError(f"floor plan: none of {ATTEMPTS} draws was usable; use another seed")


def _cut(rng: Rng, start: float, end: float, typical: float) -> list[tuple[float, float]]:
    """Cut a stretch into pieces around `typical` metres long."""
    count = max(1, round((end - start) / typical))
    shares = rng.uniform(0.72, 1.28, count).cumsum()
    edges = [start, *(start + (end - start) * shares / shares[-1])]
    return [(float(a), float(b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def _along_corridor(rng: Rng, area: float) -> list[Cell]:
    """A corridor (the first cell) with a row of rooms on each side, and the living rooms across its end."""
    width, north = rng.uniform(1.25, 1.6), rng.uniform(2.9, 4.2)
    south = rng.uniform(2.9, 4.1) if area > 80 else rng.uniform(2.0, 2.7)
    depth = width + north + south
    length = area / depth
    slab = float(np.clip(length * rng.uniform(0.34, 0.46), 3.5, 6.3))
    cells = [Cell(slab, south, length, south + width)]
    cells += [Cell(a, 0, b, south) for a, b in _cut(rng, slab, length, rng.uniform(2.6, 3.6))]
    cells += [Cell(a, south + width, b, depth) for a, b in _cut(rng, slab, length, rng.uniform(2.9, 3.9))]
    # the living rooms may stand out beyond the rows, which makes an L
    low, high = (-rng.uniform(0, 1.5), depth) if rng.random() < 0.5 else (0.0, depth + rng.uniform(0, 1.5))
    cells += [Cell(0, a, slab, b) for a, b in _cut(rng, low, high, rng.uniform(3.2, 6.0))]
    mirrored = rng.random() < 0.5
    return [Cell(-cell.x1, cell.y0, -cell.x0, cell.y1) for cell in cells] if mirrored else cells


def _columns(rng: Rng, area: float) -> list[Cell]:
    """Rooms that open into each other, without a corridor."""
    length = float(np.sqrt(area * rng.uniform(0.9, 1.7)))
    depth = area / length
    return [
        Cell(x0, y0, x1, y1)
        for x0, x1 in _cut(rng, 0, length, rng.uniform(3.2, 4.6))
        for y0, y1 in _cut(rng, 0, depth, rng.uniform(3.0, 4.8))
    ]


WISHES: tuple[tuple[RoomKind, ...], ...] = (
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
"""What the rooms beside living room and corridor are for, by their number, the largest first."""


def _rooms(rng: Rng, cells: list[Cell], corridor: bool) -> list[Room] | None:
    """Give each cell a use: several orders are tried, and the best by `_suits` is kept."""
    half = WALL / 2
    bare = [Room("corridor", c.x0 + half, c.y0 + half, c.x1 - half, c.y1 - half) for c in cells]
    free = list(range(1 if corridor else 0, len(cells)))
    living = max(free, key=lambda number: bare[number].area)
    rest = sorted((number for number in free if number != living), key=lambda number: -bare[number].area)
    if not 1 <= len(rest) <= len(WISHES) or bare[living].area < 11 or bare[rest[0]].area < 7.5:
        return None
    best, best_score = None, -np.inf
    for _ in range(10):
        # noise on the sizes mixes rooms of similar area
        order = sorted(rest, key=lambda number: -bare[number].area * rng.uniform(0.8, 1.2))
        kinds: dict[int, RoomKind] = {living: "living"}
        kinds |= dict(zip(order, WISHES[len(rest) - 1], strict=True))
        rooms = [Room(kinds.get(n, "corridor"), r.x0, r.y0, r.x1, r.y1) for n, r in enumerate(bare)]
        score = _suits(cells, rooms)
        if score > best_score:
            best, best_score = rooms, score
    return best if best_score > 0 else None


def _suits(cells: list[Cell], rooms: list[Room]) -> float:
    """How well rooms suit their uses; not positive if one is impossible."""
    score = 1.0
    for number, room in enumerate(rooms):
        behind = {
            rooms[s.other].kind for s in walls_of(cells, number) if s.other != OUTSIDE and s.length > 1.4
        }
        if room.kind == "bedroom" and (room.area < 7.0 or min(room.size) < 2.3):
            score -= 100
        if room.kind in ("dining", "office", "kitchen") and min(room.size) < 1.9:
            score -= 100
        score += 2.0 * (
            room.kind in ("kitchen", "dining")
            and bool(behind & {"living", "dining", "kitchen"} - {room.kind})
        )
        score -= room.area / 10 * (room.kind in ("bathroom", "kitchen"))
        score += 1.0 * (room.kind == "bedroom" and "corridor" in behind)
    return score + 10


def walls_of(cells: list[Cell], number: int) -> Iterator[Shared]:
    """The stretches of wall around a cell, by what is behind them."""
    cell = cells[number]
    for axis, at, start, end in (
        (0, cell.y0, cell.x0, cell.x1),
        (0, cell.y1, cell.x0, cell.x1),
        (1, cell.x0, cell.y0, cell.y1),
        (1, cell.x1, cell.y0, cell.y1),
    ):
        pieces = []
        for other, behind in enumerate(cells):
            if other == number:
                continue
            low, high = (behind[0], behind[2]) if axis == 0 else (behind[1], behind[3])
            sides = (behind[1], behind[3]) if axis == 0 else (behind[0], behind[2])
            if min(abs(at - side) for side in sides) < 1e-6 and min(end, high) - max(start, low) > 1e-6:
                pieces.append(Shared(axis, at, max(start, low), min(end, high), other))
        place = start
        for piece in sorted(pieces, key=lambda piece: piece.start):
            if piece.start - place > 1e-6:
                yield Shared(axis, at, place, piece.start, OUTSIDE)
            yield piece
            place = piece.end
        if end - place > 1e-6:
            yield Shared(axis, at, place, end, OUTSIDE)


def _wish(first: RoomKind, second: RoomKind) -> float:
    """How unwelcome a door between two kinds of rooms is: the smaller, the better."""
    pair = {first, second}
    if pair <= {"living", "dining", "kitchen", "corridor"}:
        return 0.0
    if "corridor" in pair:
        return 1.0
    return {"bathroom": 4.0, "bedroom": 3.0}.get(first, 2.0) + {"bathroom": 4.0, "bedroom": 3.0}.get(
        second, 2.0
    )


def _doors(rng: Rng, cells: list[Cell], rooms: list[Room]) -> list[Opening] | None:
    """Doors that join all rooms, the welcome ones first, and now and then one more; None if a room cannot be joined."""
    walls = [
        (_wish(rooms[number].kind, rooms[wall.other].kind) + rng.uniform(0, 0.9), number, wall)
        for number in range(len(cells))
        for wall in walls_of(cells, number)
        if wall.other > number and wall.length > 1.0 + 2 * WALL
    ]
    group = list(range(len(cells)))
    doors, joined = [], set()
    for wish, number, wall in sorted(walls):
        pair = (number, wall.other)
        spare = wish < 1.0 and rng.random() < 0.4
        if pair in joined or (group[number] == group[wall.other] and not spare):
            continue
        joined.add(pair)
        old, new = group[wall.other], group[number]
        group = [new if name == old else name for name in group]
        doors.append(_door(rng, number, wall, {rooms[number].kind, rooms[wall.other].kind}))
    return doors if len(set(group)) == 1 else None


def _door(rng: Rng, number: int, wall: Shared, kinds: set[RoomKind]) -> Opening:
    """A door in a wall, mostly near one of its ends; between living rooms often a wide passage."""
    start, end = wall.start + WALL, wall.end - WALL
    kind: OpeningKind = "door"
    width, high = rng.uniform(0.85, 1.0), 2.05
    if kinds <= {"living", "dining", "kitchen", "corridor"} and rng.random() < 0.6:
        kind, width, high = "passage", min(rng.uniform(1.1, 2.2), (end - start) * 0.8), rng.uniform(2.05, 2.3)
    spare = end - start - width
    near = min(spare, rng.uniform(0.1, 0.3)) if rng.random() < 0.7 else spare * rng.random()
    low = start + (near if rng.random() < 0.5 else spare - near)
    return Opening(kind, (number, wall.other), wall.axis, wall.at, low, low + width, 0.0, high)


def _facade(rng: Rng, cells: list[Cell], rooms: list[Room]) -> list[Opening]:
    """Windows in the outer walls, and the entrance."""
    openings = []
    order = sorted(
        range(len(rooms)), key=lambda n: {"corridor": 0, "living": 1, "kitchen": 2}.get(rooms[n].kind, 3)
    )
    entered = False
    for number in order:
        kind = rooms[number].kind
        for wall in walls_of(cells, number):
            start, end = wall.start + 0.35, wall.end - 0.35
            if wall.other != OUTSIDE or end - start < 0.6:
                continue
            if not entered and end - start > 0.95:
                low = start + (end - start - 0.95) * rng.choice([0.0, 1.0])
                entered = True
                openings.append(
                    Opening("entrance", (number, OUTSIDE), wall.axis, wall.at, low, low + 0.95, 0.0, 2.05)
                )
            elif kind != "corridor" and rng.random() < 0.8:
                width = min(
                    rng.uniform(0.55, 0.8) if kind == "bathroom" else rng.uniform(0.9, 2.0), end - start
                )
                low = start + (end - start - width) * rng.uniform(0.25, 0.75)
                sill = {"bathroom": 1.3, "living": rng.choice([0.12, 0.6, 0.85])}.get(
                    kind, rng.uniform(0.8, 1.05)
                )
                openings.append(
                    Opening(
                        "window", (number, OUTSIDE), wall.axis, wall.at, low, low + width, float(sill), 2.1
                    )
                )
    return openings
