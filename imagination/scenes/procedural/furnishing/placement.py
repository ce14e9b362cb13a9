"""What stands where in a room: nothing overlaps, doors stay clear, and a robot gets from each door to the others."""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from imagination.scenes.building_blocks.pieces import Placed, rectangle_at
from imagination.scenes.procedural.floor_plan.plan import OUTSIDE, Plan, Room, before

CELL = 0.05
"""Side of the cells in which the way through a room is checked, metres."""
DOOR_ZONE = 0.85
"""Depth of the floor kept clear before a door, metres."""
TALL = 0.95
"""Height from which furniture does not stand before windows, metres."""
FLAT = 0.03
"""What is lower is walked over: rugs."""

FREE_SHARE = 0.15
"""Share of a room's floor that furniture leaves to the robot's centre."""

Corners = Float[np.ndarray, "4 2"]


def overlap(first: Corners, second: Corners) -> bool:
    """Whether two rectangles overlap, by the separating axis theorem; touching is no overlap."""
    for corners in (first, second):
        axes = np.stack([corners[1] - corners[0], corners[3] - corners[0]])
        one, two = first @ axes.T, second @ axes.T
        # compared in units of squared metres along each axis: a hair of tolerance lets things stand side by side
        if ((one.max(axis=0) <= two.min(axis=0) + 1e-6) | (two.max(axis=0) <= one.min(axis=0) + 1e-6)).any():
            return False
    return True


class RoomFloor:
    """The furniture of one room while it is being placed.

    Attributes:
        room: where.
        placed: what stands in it so far, in the plan's frame.
    """

    def __init__(self, plan: Plan, number: int, robot_radius: float) -> None:
        self.room: Room = plan.rooms[number]
        self.placed: list[Placed] = []
        self.kept_clear: list[Corners] = []
        self.windows: list[Corners] = []
        self._doors: list[Corners] = []
        self._radius = robot_radius + CELL
        self._doorsteps: list[tuple[float, float]] = []
        for opening in plan.openings_of(number):
            # an open leaf is as long as its door is wide
            depth = {"window": 0.5, "door": opening.end - opening.start + 0.05}.get(opening.kind, DOOR_ZONE)
            x0, y0, x1, y1 = before(opening, self.room, depth, 0.03)
            zone = rectangle_at((x0, y0), (x1, y1), 0.0, 0.0, 0.0)
            if opening.kind == "window":
                self.windows.append(zone)
                continue
            self._doors.append(zone)
            if OUTSIDE not in opening.rooms:
                x, y = zone.mean(axis=0)
                self._doorsteps.append((float(x), float(y)))
        self.kept_clear += self._doors
        shape = tuple(int(np.ceil(side / CELL)) for side in self.room.size[::-1])
        self._blocked = np.ones(shape, np.uint8)
        rim = int(np.ceil(self._radius / CELL))
        self._blocked[rim:-rim, rim:-rim] = 0
        for x, y in self._doorsteps:  # the rim before a door is free
            self._blocked[self._cell(x, y)] = 0

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        rows, columns = self._blocked.shape
        row, column = int((y - self.room.y0) / CELL), int((x - self.room.x0) / CELL)
        return min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)

    def fits(self, objects: Sequence[Placed], next_to: Iterable[Placed] = ()) -> bool:
        """Whether things may stand where they are; `beside` are those that they may reach under."""
        excused = {id(obj) for obj in next_to}
        others = [obj for obj in self.placed if id(obj) not in excused and not is_flat(obj)]
        for obj in objects:
            if is_flat(obj):
                continue
            corners = obj.footprint()
            tall = obj.z + obj.piece.high[2] > TALL and (obj.z == 0 or obj.z > TALL)
            if tall and any(overlap(corners, zone) for zone in self.windows):
                return False
            if obj.z > 0:  # stands on another of the same group, or hangs on the wall above it
                continue
            if not self.inside(corners) or any(overlap(corners, zone) for zone in self.kept_clear):
                return False
            if any(overlap(corners, other.footprint()) for other in others):
                return False
        return self._passable(objects)

    def inside(self, corners: Corners) -> bool:
        """Whether a rectangle lies within the room's walls."""
        room = self.room
        above, below = (
            corners >= (room.x0 - 1e-6, room.y0 - 1e-6),
            corners <= (room.x1 + 1e-6, room.y1 + 1e-6),
        )
        return bool(above.all() and below.all())

    def _with(self, objects: Iterable[Placed]) -> Bool[np.ndarray, "h w"]:
        """The cells a robot's centre cannot be in."""
        blocked = self._blocked.copy()
        for obj in objects:
            corners = (obj.footprint(self._radius) - (self.room.x0, self.room.y0)) / CELL - 0.5
            cv2.fillConvexPoly(blocked, np.round(corners * 16).astype(np.int32), 1, shift=4)
        return blocked > 0

    def _passable(self, objects: Sequence[Placed]) -> bool:
        """Whether all doors of the room stay joined, and enough of the floor with them."""
        free = ~self._with([obj for obj in objects if obj.z == 0 and not is_flat(obj)])
        _, parts = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
        if not self._doorsteps:
            return bool(free.any())
        names = {int(parts[self._cell(x, y)]) for x, y in self._doorsteps}
        if len(names) > 1 or 0 in names:
            return False
        # furniture must not wall off part of the room either, nor fill it
        reached = int((parts == names.pop()).sum())
        return bool(reached >= 0.75 * free.sum() and reached >= FREE_SHARE * free.size)

    def put(self, objects: Sequence[Placed]) -> None:
        """Let things stand where they are."""
        self.placed += objects
        self._blocked = self._with([obj for obj in objects if obj.z == 0 and not is_flat(obj)]).astype(
            np.uint8
        )

    def keep_clear(self, corners: Corners) -> None:
        """Let nothing more stand in a rectangle."""
        self.kept_clear.append(corners)

    def clear_above(self, corners: Corners, low: float) -> bool:
        """Whether nothing placed reaches above height `low` over a rectangle."""
        return not any(
            obj.z + obj.piece.high[2] > low and overlap(corners, obj.footprint()) for obj in self.placed
        )

    def wall_is_free(self, picture: Placed) -> bool:
        """Whether a picture hangs before nothing but the wall: no door, no window, no tall furniture."""
        corners = picture.footprint(0.05)
        return self.clear_above(corners, picture.z - 0.1) and not any(
            overlap(corners, zone) for zone in [*self.windows, *self._doors]
        )


def is_flat(obj: Placed) -> bool:
    """Whether a thing lies flat on the floor, so that others stand on it."""
    return bool(obj.piece.high[2] + obj.z <= FLAT)


def extent(group: Sequence[Placed]) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Smallest and largest x, y of a group's footprints."""
    corners = np.concatenate([obj.footprint() for obj in group])
    return corners.min(axis=0), corners.max(axis=0)


def moved(group: Sequence[Placed], x: float, y: float, yaw: float, z: float = 0.0) -> list[Placed]:
    """A group, each thing's place being relative to a frame at (x, y, z) turned by `yaw`."""
    return [obj.within(x, y, yaw, z) for obj in group]


def wall_pose(
    room: Room, side: int, share: float, low: np.ndarray, high: np.ndarray, gap: float
) -> tuple[float, float, float] | None:
    """Pose that puts a group's back (its lowest y) on a wall (0 south, 1 east, 2 north, 3 west); None if too long.

    Args:
        room: with the wall.
        side: which wall.
        share: 0 puts the group at the wall's left end as seen from the room's middle looking at it, 1 at its right end.
        low, high: extent of the group in its own frame.
        gap: between its back and the wall, metres.
    """
    yaw = (0.0, np.pi / 2, np.pi, -np.pi / 2)[side]
    length = room.size[side % 2]
    spare = length - (high[0] - low[0]) - 2 * 0.02
    if spare < 0:
        return None
    along = (
        0.02 + spare * share - low[0]
    )  # of the group's origin, from the end of the wall where its x starts
    out = gap - low[1]
    match side:
        case 0:
            return room.x0 + along, room.y0 + out, yaw
        case 1:
            return room.x1 - out, room.y0 + along, yaw
        case 2:
            return room.x1 - along, room.y1 - out, yaw
        case _:
            return room.x0 + out, room.y1 - along, yaw
