"""Floor plans: rooms side by side, what each is for, and the openings between them."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

RoomKind = Literal["living", "dining", "kitchen", "bedroom", "office", "bathroom", "corridor"]
OpeningKind = Literal["door", "passage", "window", "entrance"]

WALL = 0.12
"""Thickness of inner walls, metres."""
OUTSIDE = -1


class Cell(NamedTuple):
    """An upright rectangle, metres; of a room: between the middles of its walls."""

    x0: float
    y0: float
    x1: float
    y1: float

    def meets(self, other: "Cell") -> bool:
        """Whether two rectangles overlap."""
        return bool(self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1)


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


def before(opening: Opening, room: Room, depth: float, margin: float = 0.0) -> Cell:
    """The floor of a room before an opening in its wall, `depth` deep; `margin` is added at each end."""
    start, end = opening.start - margin, opening.end + margin
    if opening.axis == 0:
        low = room.y0 if opening.at < room.y0 else room.y1 - depth
        return Cell(start, low, end, low + depth)
    low = room.x0 if opening.at < room.x0 else room.x1 - depth
    return Cell(low, start, low + depth, end)
