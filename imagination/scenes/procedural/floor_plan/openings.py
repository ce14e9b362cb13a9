"""Wall segments between the cells of a plan, and their doors, passages and windows."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from imagination.scenes.procedural.floor_plan.plan import (
    OUTSIDE,
    WALL,
    Cell,
    Opening,
    OpeningKind,
    Room,
    RoomKind,
)

Rng = np.random.Generator


class WallSegment(NamedTuple):
    """Segment of a wall: axis 0 is along x; `other` is the cell behind it, or OUTSIDE."""

    axis: int
    at: float
    start: float
    end: float
    other: int

    @property
    def length(self) -> float:
        return self.end - self.start


def wall_segments(cells: list[Cell], number: int) -> Iterator[WallSegment]:
    """Yield the wall segments around a cell, split by the cells behind them."""
    cell = cells[number]
    for axis, at, start, end in (
        (0, cell.y0, cell.x0, cell.x1),
        (0, cell.y1, cell.x0, cell.x1),
        (1, cell.x0, cell.y0, cell.y1),
        (1, cell.x1, cell.y0, cell.y1),
    ):
        segments = []
        for other, behind in enumerate(cells):
            if other == number:
                continue
            low, high = (behind[0], behind[2]) if axis == 0 else (behind[1], behind[3])
            sides = (behind[1], behind[3]) if axis == 0 else (behind[0], behind[2])
            if min(abs(at - side) for side in sides) < 1e-6 and min(end, high) - max(start, low) > 1e-6:
                segments.append(WallSegment(axis, at, max(start, low), min(end, high), other))
        position = start
        for segment in sorted(segments, key=lambda segment: segment.start):
            if segment.start - position > 1e-6:
                yield WallSegment(axis, at, position, segment.start, OUTSIDE)
            yield segment
            position = segment.end
        if end - position > 1e-6:
            yield WallSegment(axis, at, position, end, OUTSIDE)


def _door_cost(first: RoomKind, second: RoomKind) -> float:
    """Return the cost of a door between two kinds of rooms."""
    pair = {first, second}
    if pair <= {"living", "dining", "kitchen", "corridor"}:
        return 0.0
    if "corridor" in pair:
        return 1.0
    return {"bathroom": 4.0, "bedroom": 3.0}.get(first, 2.0) + {"bathroom": 4.0, "bedroom": 3.0}.get(
        second, 2.0
    )


def draw_doors(rng: Rng, cells: list[Cell], rooms: list[Room]) -> list[Opening] | None:
    """Draw doors that connect all rooms, cheapest first, and some extra doors; return None if a room is unreachable."""
    walls = [
        (_door_cost(rooms[number].kind, rooms[wall.other].kind) + rng.uniform(0, 0.9), number, wall)
        for number in range(len(cells))
        for wall in wall_segments(cells, number)
        if wall.other > number and wall.length > 1.0 + 2 * WALL
    ]
    component = list(range(len(cells)))
    doors, connected = [], set()
    for cost, number, wall in sorted(walls):
        pair = (number, wall.other)
        extra = cost < 1.0 and rng.random() < 0.4
        if pair in connected or (component[number] == component[wall.other] and not extra):
            continue
        connected.add(pair)
        old, new = component[wall.other], component[number]
        component = [new if name == old else name for name in component]
        doors.append(_door(rng, number, wall, {rooms[number].kind, rooms[wall.other].kind}))
    return doors if len(set(component)) == 1 else None


def _door(rng: Rng, number: int, wall: WallSegment, kinds: set[RoomKind]) -> Opening:
    """Draw a door in a wall, usually near one of its ends; between living rooms often a wide passage."""
    start, end = wall.start + WALL, wall.end - WALL
    kind: OpeningKind = "door"
    width, high = rng.uniform(0.85, 1.0), 2.05
    wide = min(rng.uniform(1.1, 2.2), (end - start) * 0.8)
    if kinds <= {"living", "dining", "kitchen", "corridor"} and wide > 1.0 and rng.random() < 0.6:
        kind, width, high = "passage", wide, rng.uniform(2.05, 2.3)
    slack = end - start - width
    near = min(slack, rng.uniform(0.1, 0.3)) if rng.random() < 0.7 else slack * rng.random()
    low = start + (near if rng.random() < 0.5 else slack - near)
    return Opening(kind, (number, wall.other), wall.axis, wall.at, low, low + width, 0.0, high)


def draw_facade(rng: Rng, cells: list[Cell], rooms: list[Room]) -> list[Opening]:
    """Draw windows in the outer walls, and the entrance."""
    openings = []
    order = sorted(
        range(len(rooms)), key=lambda n: {"corridor": 0, "living": 1, "kitchen": 2}.get(rooms[n].kind, 3)
    )
    has_entrance = False
    for number in order:
        kind = rooms[number].kind
        for wall in wall_segments(cells, number):
            start, end = wall.start + 0.35, wall.end - 0.35
            if wall.other != OUTSIDE or end - start < 0.6:
                continue
            if not has_entrance and end - start > 0.95:
                low = start + (end - start - 0.95) * rng.choice([0.0, 1.0])
                has_entrance = True
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
