"""Building of one level of a home: floors, ceilings and walls with openings."""

from collections.abc import Sequence

import cv2
import numpy as np

from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.building_blocks.pieces import Assembly, Piece
from imagination.scenes.building_blocks.shapes import Solid, box
from imagination.scenes.scene import Material
from imagination.utils.errors import UserError, require_extra
from imagination_sweethome3d.home_file import Colour, HomePiece, Level, Room, Wall

MAX_DOOR_SILL = 0.15
"""Maximum height of the bottom of a door, metres; doors are open, and higher openings are windows with a pane."""
GLASS = (0.80, 0.88, 0.95)
"""Colour of window panes, RGB in [0, 1]."""
MAX_PARTS = 50_000
"""Maximum number of boxes of the walls of a level."""
MAX_PAIRS = 1_000_000
"""Maximum number of pairs of a wall and an opening of a level."""
MAX_OFFSET = 0.35
"""Maximum distance of the centre of an opening from the centre line of its wall, metres."""


def build_shell(level: Level) -> Piece:
    """Build the floors, ceilings and walls of a level, with the floor at height 0.

    Raises:
        UserError: if the level has too many walls and openings, or mapbox_earcut is not installed.
    """
    if len(level.walls) * len(level.openings) > MAX_PAIRS:
        raise UserError(
            f"level {level.name!r}: got {len(level.walls)} walls and {len(level.openings)} doors and windows, expected "
            f"at most {MAX_PAIRS} pairs of them"
        )
    shell = Assembly("building", "building")
    finishes: dict[Colour, Finish] = {}

    def finish(colour: Colour) -> Finish:
        return finishes.setdefault(colour, Finish(Material(colour)))

    for room in level.rooms or (_bounding_room(level.walls),):
        floor = triangulate(room)
        shell.add(floor, finish(room.floor))
        if room.has_ceiling:
            shell.add(
                Solid(floor.vertices + [0, 0, level.height], floor.faces[:, ::-1]), finish(room.ceiling)
            )
    for wall in level.walls:
        _add_wall(shell, wall, level.openings, finish(wall.colour), finish(GLASS))
    return shell.finished()


def triangulate(room: Room) -> Solid:
    """Triangulate the floor of a room, a polygon without holes, with normals upwards.

    Raises:
        UserError: if mapbox_earcut is not installed.
    """
    require_extra("mapbox_earcut", "sweethome3d")
    from mapbox_earcut import triangulate_float64

    points = np.array(room.outline, np.float64)
    faces = triangulate_float64(points, np.array([len(points)], np.uint32)).astype(np.int64).reshape(-1, 3)
    vertices = np.column_stack([points, np.zeros(len(points))])
    corners = points[faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    down = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0
    faces[down] = faces[down][:, ::-1]
    return Solid(vertices, faces)


def _bounding_room(walls: Sequence[Wall]) -> Room:
    """Return the smallest rectangle around the walls of a level without rooms."""
    points = np.array([end for wall in walls for end in (wall.start, wall.end)], np.float32)
    corners = cv2.boxPoints(cv2.minAreaRect(points)).astype(float)
    outline = tuple((float(x), float(y)) for x, y in corners)
    return Room(outline, (0.7, 0.62, 0.5), (0.97, 0.97, 0.96), True)


def _add_wall(
    shell: Assembly, wall: Wall, openings: Sequence[HomePiece], finish: Finish, glass: Finish
) -> None:
    """Add a wall as boxes: split it at all edges of its openings and leave out the boxes inside an opening."""
    start, end = np.array(wall.start), np.array(wall.end)
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    yaw = float(np.arctan2(along[1], along[0]))
    holes = [hole for piece in openings if (hole := _hole(piece, wall, start, along, length)) is not None]
    cuts_s = np.unique(np.clip([0.0, length, *(s for hole in holes for s in hole[:2])], 0, length))
    cuts_z = np.unique(np.clip([0.0, wall.height, *(z for hole in holes for z in hole[2:])], 0, wall.height))
    if len(shell.parts) + len(cuts_s) * len(cuts_z) > MAX_PARTS:
        raise UserError(
            f"walls: got more than {MAX_PARTS} boxes around {len(openings)} doors and windows, expected at most "
            f"{MAX_PARTS}"
        )
    for s0, s1 in zip(cuts_s[:-1], cuts_s[1:], strict=True):
        for z0, z1 in zip(cuts_z[:-1], cuts_z[1:], strict=True):
            s, z = (s0 + s1) / 2, (z0 + z1) / 2
            if not any(hole[0] < s < hole[1] and hole[2] < z < hole[3] for hole in holes):
                x, y = start + along * s
                shell.add(box(s1 - s0, wall.thickness, z1 - z0), finish, (x, y, z0), yaw)
    for s0, s1, z0, z1 in holes:
        if z0 > MAX_DOOR_SILL:
            x, y = start + along * (s0 + s1) / 2
            shell.add(box(s1 - s0, 0.01, z1 - z0), glass, (x, y, z0), yaw)


def _hole(
    piece: HomePiece, wall: Wall, start: np.ndarray, along: np.ndarray, length: float
) -> tuple[float, float, float, float] | None:
    """Return the range of a door or window along a wall and of its height, or None if it is in another wall."""
    offset = np.array(piece.centre) - start
    s, off = float(offset @ along), float(along[0] * offset[1] - along[1] * offset[0])
    direction = np.array([np.cos(piece.yaw), np.sin(piece.yaw)])
    parallel = abs(float(direction @ along)) > 0.95
    half = piece.size[0] / 2
    if not parallel or abs(off) > max(MAX_OFFSET, wall.thickness) or s + half <= 0 or s - half >= length:
        return None
    return s - half, s + half, piece.elevation, piece.elevation + piece.size[2]
