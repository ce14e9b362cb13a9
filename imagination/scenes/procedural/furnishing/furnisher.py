"""Finding places for things in one room."""

from collections.abc import Sequence

import numpy as np

from imagination.scenes.building_blocks.pieces import Placed, rectangle_at
from imagination.scenes.procedural.furnishing.groups import on_top_of
from imagination.scenes.procedural.furnishing.placement import RoomFloor, extent, is_flat, moved, wall_pose
from imagination.scenes.procedural.furniture.stock import Stock

TRIES = 24
"""Places tried for a thing before the room goes without it."""
ALONG = np.array([0.0, 1.0, 0.5])
"""Where along a wall things like to stand: in its corners and in its middle."""


class Furnisher:
    """Places things in one room by rules, as far as they fit."""

    def __init__(self, floor: RoomFloor, stock: Stock) -> None:
        self.floor = floor
        self.stock = stock
        self.rng = stock.rng

    def against_wall(
        self,
        group: Sequence[Placed],
        chairs: Sequence[Placed] = (),
        clear: float = 0.0,
        tries: int = TRIES,
        sides: Sequence[int] = (0, 1, 2, 3),
    ) -> int | None:
        """Put a group with its back to a wall, and its chairs as far as they fit.

        Args:
            group: in its own frame.
            chairs: pushed under the group's first thing.
            clear: depth of the floor before the group on which nothing may stand later, metres.
            tries: places tried.
            sides: walls to choose from, as in `wall_pose`.

        Returns:
            the wall, None if the group fitted nowhere.
        """
        standing = [obj for obj in group if obj.z == 0 and not is_flat(obj)]
        low, high = extent(standing)
        for _ in range(tries):
            side = int(self.rng.choice(sides))
            share = float(self.rng.choice(ALONG)) if self.rng.random() < 0.6 else float(self.rng.random())
            pose = wall_pose(self.floor.room, side, share, low, high, float(self.rng.uniform(0.02, 0.05)))
            if pose is None:
                continue
            placed = moved(group, *pose)
            zone = rectangle_at((low[0], high[1]), (high[0], high[1] + clear), *pose)
            if clear and not self.floor.clear_above(zone, 0.05):
                continue
            if self._put(placed, moved(chairs, *pose)):
                if clear:
                    self.floor.keep_clear(zone)
                return side
        return None

    def freely(
        self, group: Sequence[Placed], chairs: Sequence[Placed] = (), tries: int = TRIES, turned: bool = False
    ) -> bool:
        """Put a group anywhere in the room, square to its walls or `turned` by any angle."""
        room = self.floor.room
        for _ in range(tries):
            yaw = float(self.rng.uniform(-np.pi, np.pi) if turned else self.rng.integers(4) * np.pi / 2)
            # nearer to the middle than to the walls
            x = room.x0 + room.size[0] * float(self.rng.beta(2.5, 2.5))
            y = room.y0 + room.size[1] * float(self.rng.beta(2.5, 2.5))
            if self._put(moved(group, x, y, yaw), moved(chairs, x, y, yaw)):
                return True
        return False

    def _put(self, objects: list[Placed], chairs: list[Placed]) -> bool:
        """Let things stand where they are with those of their chairs that fit; refuse if most of these do not."""
        # a rug that does not fit is left out, the rest stays
        objects = [obj for obj in objects if not is_flat(obj) or self.floor.inside(obj.footprint())]
        if not self.floor.fits(objects):
            return False
        if 2 * sum(self.floor.fits([chair], next_to=objects) for chair in chairs) < len(chairs):
            return False
        self.floor.put(objects)
        for chair in chairs:
            if self.floor.fits([chair], next_to=objects):
                self.floor.put([chair])
        return True

    def stand(self, label: str, chance: float = 1.0, clear: float = 0.0, topped: Sequence[str] = ()) -> None:
        """By chance, put one thing against a wall, with smaller things on it."""
        if self.stock.chance(chance):
            obj = Placed(self.stock.piece(label))
            self.against_wall([obj, *on_top_of(obj, self.stock, topped, 0.4)], clear=clear)

    def loose(self, label: str, chance: float = 1.0) -> None:
        """By chance, put one thing somewhere, turned by any angle: near a wall or in the room."""
        if not self.stock.chance(chance):
            return
        # the pose of its own frame is turned, so that its back is not quite against the wall
        obj = Placed(self.stock.piece(label), 0.0, 0.0, float(self.rng.normal(0, 0.35)))
        if self.stock.chance(0.65):
            self.against_wall([obj])
        else:
            self.freely([obj], turned=True)

    def hang(self, count: int) -> None:
        """Hang pictures where the wall is free."""
        for _ in range(count):
            picture = self.stock.piece("picture")
            height = float(self.rng.uniform(1.25, 1.5))
            for _ in range(6):
                side, share = int(self.rng.integers(4)), float(self.rng.uniform(0.15, 0.85))
                pose = wall_pose(self.floor.room, side, share, picture.low[:2], picture.high[:2], 0.003)
                if pose is None:
                    continue
                placed = Placed(picture).within(*pose, height)
                if self.floor.wall_is_free(placed):
                    self.floor.put([placed])
                    break
