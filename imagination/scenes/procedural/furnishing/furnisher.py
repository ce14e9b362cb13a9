"""Search for positions of furniture in one room."""

from collections.abc import Sequence

import numpy as np

from imagination.scenes.building_blocks.pieces import Placed, rectangle_at
from imagination.scenes.procedural.furnishing.groups import on_top_of
from imagination.scenes.procedural.furnishing.placement import RoomFloor, extent, is_flat, moved, wall_pose
from imagination.scenes.procedural.furniture.procedural_furniture import Stock

TRIES = 24
"""Maximum number of positions tried for a piece before it is left out."""
ALONG = np.array([0.0, 1.0, 0.5])
"""Preferred positions along a wall, as fractions of the free length: corners and centre."""


class Furnisher:
    """Furnisher of one room; pieces that do not fit are left out."""

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
        """Place a group with its back to a wall, with those of its chairs that fit.

        Args:
            group: pieces in the frame of the group.
            chairs: chairs under the first piece of the group.
            clear: depth of the floor in front of the group that is kept clear, metres.
            tries: maximum number of positions tried.
            sides: walls to draw from, as in `wall_pose`.

        Returns:
            The wall, or None if the group does not fit.
        """
        standing = [obj for obj in group if obj.z == 0 and not is_flat(obj)]
        low, high = extent(standing)
        for _ in range(tries):
            side = int(self.rng.choice(sides))
            fraction = float(self.rng.choice(ALONG)) if self.rng.random() < 0.6 else float(self.rng.random())
            pose = wall_pose(self.floor.room, side, fraction, low, high, float(self.rng.uniform(0.02, 0.05)))
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
        """Place a group anywhere in the room, aligned with its walls or `turned` by any angle."""
        room = self.floor.room
        for _ in range(tries):
            yaw = float(self.rng.uniform(-np.pi, np.pi) if turned else self.rng.integers(4) * np.pi / 2)
            # positions near the centre of the room are more likely
            x = room.x0 + room.size[0] * float(self.rng.beta(2.5, 2.5))
            y = room.y0 + room.size[1] * float(self.rng.beta(2.5, 2.5))
            if self._put(moved(group, x, y, yaw), moved(chairs, x, y, yaw)):
                return True
        return False

    def _put(self, objects: list[Placed], chairs: list[Placed]) -> bool:
        """Place objects at their poses with the chairs that fit; return False if most of the chairs do not fit."""
        # a rug that does not fit is left out
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

    def stand(self, label: str, chance: float = 1.0, clear: float = 0.0, on_top: Sequence[str] = ()) -> None:
        """With a probability, place one piece against a wall, with smaller objects on it."""
        if self.stock.chance(chance):
            obj = Placed(self.stock.piece(label))
            self.against_wall([obj, *on_top_of(obj, self.stock, on_top, 0.4)], clear=clear)

    def loose(self, label: str, chance: float = 1.0) -> None:
        """With a probability, place one piece near a wall or anywhere in the room, turned by any angle."""
        if not self.stock.chance(chance):
            return
        # rotated in the frame of the group, so that its back is not exactly parallel to the wall
        obj = Placed(self.stock.piece(label), 0.0, 0.0, float(self.rng.normal(0, 0.35)))
        if self.stock.chance(0.65):
            self.against_wall([obj])
        else:
            self.freely([obj], turned=True)

    def hang(self, count: int) -> None:
        """Place up to `count` pictures on free parts of the walls."""
        for _ in range(count):
            picture = self.stock.piece("picture")
            height = float(self.rng.uniform(1.25, 1.5))
            for _ in range(6):
                side, fraction = int(self.rng.integers(4)), float(self.rng.uniform(0.15, 0.85))
                pose = wall_pose(self.floor.room, side, fraction, picture.low[:2], picture.high[:2], 0.003)
                if pose is None:
                    continue
                placed = Placed(picture).within(*pose, height)
                if self.floor.wall_is_free(placed):
                    self.floor.put([placed])
                    break
