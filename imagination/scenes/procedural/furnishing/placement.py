"""Placement of furniture in a room: no overlap, clear doors, and a path for the robot between all inner doors."""

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from imagination.scenes.building_blocks.pieces import Placed, rectangle_at
from imagination.scenes.procedural.floor_plan.plan import OUTSIDE, Plan, Room, before

CELL = 0.05
"""Side of a cell of the grid on which paths through a room are checked, metres."""
DOOR_ZONE = 0.85
"""Depth of the floor area that is kept clear in front of passages and entrances, metres."""
TALL = 0.95
"""Maximum height of furniture in front of windows, metres."""
FLAT = 0.03
"""Maximum height of flat objects such as rugs, which do not block the floor, metres."""

MIN_FREE_FRACTION = 0.15
"""Minimum fraction of a room's floor that remains free for the centre of the robot."""

Corners = Float[np.ndarray, "4 2"]


def overlap(first: Corners, second: Corners) -> bool:
    """Return whether two rectangles overlap, by the separating axis theorem; contact is not overlap."""
    for corners in (first, second):
        axes = np.stack([corners[1] - corners[0], corners[3] - corners[0]])
        a, b = first @ axes.T, second @ axes.T
        # the axes are not normalized, so the projections are in square metres; the tolerance allows contact
        if ((a.max(axis=0) <= b.min(axis=0) + 1e-6) | (b.max(axis=0) <= a.min(axis=0) + 1e-6)).any():
            return False
    return True


class RoomFloor:
    """Floor of one room during furnishing.

    Args:
        plan: floor plan of the storey.
        number: index of the room in the plan.
        robot_radius: radius of the robot, metres.

    Attributes:
        room: room of the plan.
        placed: objects placed so far, in the frame of the plan.
        kept_clear: rectangles of the floor that must stay free.
        windows: rectangles of the floor in front of windows, without furniture higher than `TALL`.
    """

    def __init__(self, plan: Plan, number: int, robot_radius: float) -> None:
        self.room: Room = plan.rooms[number]
        self.placed: list[Placed] = []
        self.kept_clear: list[Corners] = []
        self.windows: list[Corners] = []
        self._doors: list[Corners] = []
        self._radius = robot_radius + CELL
        # points in front of inner doors, which paths must connect
        self._door_points: list[tuple[float, float]] = []
        for opening in plan.openings_of(number):
            # an open door leaf extends into the room by the width of the door
            depth = {"window": 0.5, "door": opening.end - opening.start + 0.05}.get(opening.kind, DOOR_ZONE)
            x0, y0, x1, y1 = before(opening, self.room, depth, 0.03)
            zone = rectangle_at((x0, y0), (x1, y1), 0.0, 0.0, 0.0)
            if opening.kind == "window":
                self.windows.append(zone)
                continue
            self._doors.append(zone)
            if OUTSIDE not in opening.rooms:
                x, y = zone.mean(axis=0)
                self._door_points.append((float(x), float(y)))
        self.kept_clear += self._doors
        shape = tuple(int(np.ceil(side / CELL)) for side in self.room.size[::-1])
        self._blocked = np.ones(shape, np.uint8)
        border = int(np.ceil(self._radius / CELL))
        self._blocked[border:-border, border:-border] = 0
        for x, y in self._door_points:  # free even within the border
            self._blocked[self._cell(x, y)] = 0

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        """Return the row and column of a point, clipped to the room."""
        rows, columns = self._blocked.shape
        row, column = int((y - self.room.y0) / CELL), int((x - self.room.x0) / CELL)
        return min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)

    def fits(self, objects: Sequence[Placed], next_to: Iterable[Placed] = ()) -> bool:
        """Return whether objects may be placed at their poses; they may overlap the objects in `next_to`."""
        ignored = {id(obj) for obj in next_to}
        others = [obj for obj in self.placed if id(obj) not in ignored and not is_flat(obj)]
        for obj in objects:
            if is_flat(obj):
                continue
            corners = obj.footprint()
            tall = obj.z + obj.piece.high[2] > TALL and (obj.z == 0 or obj.z > TALL)
            if tall and any(overlap(corners, zone) for zone in self.windows):
                return False
            if obj.z > 0:  # on top of another object, or on the wall
                continue
            if not self.inside(corners) or any(overlap(corners, zone) for zone in self.kept_clear):
                return False
            if any(overlap(corners, other.footprint()) for other in others):
                return False
        return self._passable(objects)

    def inside(self, corners: Corners) -> bool:
        """Return whether a rectangle is inside the room."""
        room = self.room
        above_low, below_high = (
            corners >= (room.x0 - 1e-6, room.y0 - 1e-6),
            corners <= (room.x1 + 1e-6, room.y1 + 1e-6),
        )
        return bool(above_low.all() and below_high.all())

    def _blocked_with(self, objects: Iterable[Placed]) -> Bool[np.ndarray, "h w"]:
        """Return the cells that the centre of the robot cannot occupy if `objects` are added."""
        blocked = self._blocked.copy()
        for obj in objects:
            corners = (obj.footprint(self._radius) - (self.room.x0, self.room.y0)) / CELL - 0.5
            cv2.fillConvexPoly(blocked, np.round(corners * 16).astype(np.int32), 1, shift=4)
        return blocked > 0

    def _passable(self, objects: Sequence[Placed]) -> bool:
        """Return whether all inner doors stay connected and enough floor stays free if `objects` are added."""
        free = ~self._blocked_with([obj for obj in objects if obj.z == 0 and not is_flat(obj)])
        _, components = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
        if not self._door_points:
            return bool(free.any())
        door_components = {int(components[self._cell(x, y)]) for x, y in self._door_points}
        if len(door_components) > 1 or 0 in door_components:  # 0 is the blocked area
            return False
        # at most a quarter of the free floor may be unreachable from the doors
        reachable = int((components == door_components.pop()).sum())
        return bool(reachable >= 0.75 * free.sum() and reachable >= MIN_FREE_FRACTION * free.size)

    def put(self, objects: Sequence[Placed]) -> None:
        """Place objects at their poses."""
        self.placed += objects
        self._blocked = self._blocked_with(
            [obj for obj in objects if obj.z == 0 and not is_flat(obj)]
        ).astype(np.uint8)

    def keep_clear(self, corners: Corners) -> None:
        """Keep a rectangle clear of objects placed later."""
        self.kept_clear.append(corners)

    def clear_above(self, corners: Corners, low: float) -> bool:
        """Return whether no placed object over a rectangle of the floor rises above the height `low`, metres."""
        return not any(
            obj.z + obj.piece.high[2] > low and overlap(corners, obj.footprint()) for obj in self.placed
        )

    def wall_is_free(self, picture: Placed) -> bool:
        """Return whether the wall behind a picture is free of doors, windows and tall furniture."""
        corners = picture.footprint(0.05)
        return self.clear_above(corners, picture.z - 0.1) and not any(
            overlap(corners, zone) for zone in [*self.windows, *self._doors]
        )


def is_flat(obj: Placed) -> bool:
    """Return whether an object lies flat on the floor and does not block it."""
    return bool(obj.piece.high[2] + obj.z <= FLAT)


def extent(group: Sequence[Placed]) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the smallest and largest x, y of the footprints of a group."""
    corners = np.concatenate([obj.footprint() for obj in group])
    return corners.min(axis=0), corners.max(axis=0)


def moved(group: Sequence[Placed], x: float, y: float, yaw: float, z: float = 0.0) -> list[Placed]:
    """Return a group with its poses transformed from a frame at (x, y, z) and `yaw` to the parent frame."""
    return [obj.within(x, y, yaw, z) for obj in group]


def wall_pose(
    room: Room, side: int, fraction: float, low: np.ndarray, high: np.ndarray, gap: float
) -> tuple[float, float, float] | None:
    """Return the pose of a group with its back (lowest y) at a wall, or None if the group is wider than the wall.

    Args:
        room: room with the wall.
        side: wall: 0 south, 1 east, 2 north, 3 west.
        fraction: position along the wall: 0 is its right end as seen from the centre of the room, 1 its left end.
        low, high: extent of the group in its frame, metres.
        gap: gap between the back of the group and the wall, metres.
    """
    yaw = (0.0, np.pi / 2, np.pi, -np.pi / 2)[side]
    length = room.size[side % 2]
    slack = length - (high[0] - low[0]) - 2 * 0.02
    if slack < 0:
        return None
    # distances of the group's origin: along the wall from its end at fraction 0, and from the wall
    along = 0.02 + slack * fraction - low[0]
    from_wall = gap - low[1]
    match side:
        case 0:
            return room.x0 + along, room.y0 + from_wall, yaw
        case 1:
            return room.x1 - from_wall, room.y0 + along, yaw
        case 2:
            return room.x1 - along, room.y1 - from_wall, yaw
        case _:
            return room.x0 + from_wall, room.y1 - along, yaw
