"""Data classes of floor plans: rooms, their kinds, and the openings between them."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

RoomKind = Literal["living", "dining", "kitchen", "bedroom", "office", "bathroom", "corridor"]
OpeningKind = Literal["door", "passage", "window", "entrance"]

WALL = 0.12
"""Thickness of inner walls, metres."""
OUTSIDE = -1
"""Index of the outside in place of a room."""


class Cell(NamedTuple):
    """Axis-aligned rectangle, metres; for a room, between the centre lines of its walls."""

    x0: float
    y0: float
    x1: float
    y1: float

    def meets(self, other: "Cell") -> bool:
        """Return whether two rectangles overlap."""
        return bool(self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1)


@dataclass(frozen=True)
class Room:
    """Rectangular room between the surfaces of its walls, metres."""

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
    """Opening in a wall.

    Attributes:
        kind: kind of the opening; entrances are closed, windows have a bright pane.
        rooms: the two adjacent rooms, or a room and OUTSIDE.
        axis: 0 if the wall is along x, 1 if along y.
        at: other coordinate of the centre line of the wall, metres.
        start, end: interval along the wall, metres.
        low, high: heights above the floor, metres.
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
    """Floor plan of one storey.

    Attributes:
        rooms: rooms of the storey.
        openings: openings in their walls.
        ceiling: height of the ceiling, metres.
    """

    rooms: tuple[Room, ...]
    openings: tuple[Opening, ...]
    ceiling: float

    @property
    def area(self) -> float:
        """Floor area of all rooms, square metres."""
        return sum(room.area for room in self.rooms)

    def openings_of(self, room: int) -> list[Opening]:
        """Return the openings in the walls of a room."""
        return [opening for opening in self.openings if room in opening.rooms]


def before(opening: Opening, room: Room, depth: float, margin: float = 0.0) -> Cell:
    """Return the floor area of a room in front of an opening, `depth` deep; `margin` is added at each end."""
    start, end = opening.start - margin, opening.end + margin
    if opening.axis == 0:
        low = room.y0 if opening.at < room.y0 else room.y1 - depth
        return Cell(start, low, end, low + depth)
    low = room.x0 if opening.at < room.x0 else room.x1 - depth
    return Cell(low, start, low + depth, end)
