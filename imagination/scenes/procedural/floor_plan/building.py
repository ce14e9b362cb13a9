"""Mesh of the building of a floor plan: floors, ceilings, walls with openings, doors and windows."""

import numpy as np

from imagination.scenes.building_blocks.palette import Finish, Palette
from imagination.scenes.building_blocks.pieces import Assembly, Piece
from imagination.scenes.building_blocks.shapes import Solid, box
from imagination.scenes.building_blocks.textures import tiles
from imagination.scenes.procedural.floor_plan.plan import WALL, Opening, Plan, before

Corner = tuple[float, float, float]
FRAME = 0.06
"""Width of door and window frames, metres."""
FRAME_OFFSET = 0.004
"""Offset of a frame from the surface of the wall in an opening, metres; it avoids coincident surfaces."""


def build_building(plan: Plan, palette: Palette, rng: np.random.Generator) -> Piece:
    """Build everything except furniture as one piece in the frame of the plan."""
    building = Assembly("building")
    for number, room in enumerate(plan.rooms):
        wet = room.kind in ("bathroom", "kitchen")
        building.add(_level(room.x0, room.y0, room.x1, room.y1, 0.0, up=True), palette.floor(wet))
        building.add(_level(room.x0, room.y0, room.x1, room.y1, plan.ceiling, up=False), palette.ceiling)
        paint = (
            palette.new_finish(tiles, (0.92, 0.93, 0.93), 1.0)
            if room.kind == "bathroom"
            else palette.pick(palette.walls)
        )
        for side in range(4):
            _wall(building, plan, number, side, paint, palette.white)
    wood = palette.pick([palette.white, *palette.woods])
    for opening in plan.openings:
        _reveal(building, opening, palette)
        if opening.kind != "passage":
            _frame(building, opening, wood)
        if opening.kind == "entrance":
            _on_wall(building, opening, box(opening.end - opening.start, 0.04, opening.high), wood, -0.02)
        elif opening.kind == "door" and rng.random() < 0.6:
            _leaf(building, opening, plan, wood, palette.metals[0])
    return building.finished()


def _quad(a: Corner, b: Corner, c: Corner, d: Corner) -> Solid:
    """Return a rectangle, visible from the side where its corners run counter-clockwise."""
    return Solid(np.array([a, b, c, d]), np.array([[0, 1, 2], [0, 2, 3]]))


def _level(x0: float, y0: float, x1: float, y1: float, z: float, up: bool) -> Solid:
    """Return a horizontal rectangle that faces up or down."""
    quad = _quad((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z))
    return quad if up else Solid(quad.vertices, quad.faces[:, ::-1])


def _wall(building: Assembly, plan: Plan, number: int, side: int, paint: Finish, white: Finish) -> None:
    """Add the inner surface of one wall of a room (0 south, 1 east, 2 north, 3 west) around its openings."""
    room = plan.rooms[number]
    axis = side % 2
    start, end = (room.x0, room.x1) if axis == 0 else (room.y0, room.y1)
    at = (room.y0, room.x1, room.y1, room.x0)[side]
    inward = (1, -1, -1, 1)[side]

    def piece(left: float, right: float, low: float, high: float) -> None:
        if right - left > 1e-6 and high - low > 1e-6:
            corners = [(left, low), (right, low), (right, high), (left, high)]
            points = [(s, at, z) if axis == 0 else (at, s, z) for s, z in corners]
            # reversed so that south and east walls face inwards
            building.add(_quad(*(points[::-1] if side in (0, 1) else points)), paint)
            if low == 0.0:
                _skirting(building, axis, at + inward * 0.006, left, right, white)

    position = start
    for opening in sorted(_openings_on(plan, number, axis, at), key=lambda opening: opening.start):
        piece(position, opening.start, 0.0, plan.ceiling)
        piece(opening.start, opening.end, 0.0, opening.low)
        piece(opening.start, opening.end, opening.high, plan.ceiling)
        position = opening.end
    piece(position, end, 0.0, plan.ceiling)


def _openings_on(plan: Plan, number: int, axis: int, at: float) -> list[Opening]:
    """Return the openings of a room in the wall whose inner surface is at `at`."""
    return [o for o in plan.openings_of(number) if o.axis == axis and abs(o.at - at) < WALL]


def _skirting(building: Assembly, axis: int, at: float, left: float, right: float, finish: Finish) -> None:
    """Add a skirting board along a wall."""
    length, middle = right - left, (left + right) / 2
    if axis == 0:
        building.add(box(length, 0.012, 0.08), finish, (middle, at, 0.0))
    else:
        building.add(box(0.012, length, 0.08), finish, (at, middle, 0.0))


def _on_wall(
    building: Assembly,
    opening: Opening,
    solid: Solid,
    finish: Finish,
    offset: float = 0.0,
    whole: bool = False,
) -> None:
    """Add a shape in an opening: x along the wall, y across it, origin at the centre of the sill."""
    x, y = opening.centre
    turn = 0.0 if opening.axis == 0 else np.pi / 2
    building.add(solid.moved((0.0, offset, 0.0)), finish, (x, y, opening.low), turn, whole=whole)


def _reveal(building: Assembly, opening: Opening, palette: Palette) -> None:
    """Add the reveal of an opening, its threshold, and the pane of a window."""
    width, height, half = opening.end - opening.start, opening.high - opening.low, WALL / 2
    left, right = -width / 2, width / 2
    pale = palette.white
    jambs = [
        _quad((left, -half, 0), (left, half, 0), (left, half, height), (left, -half, height)),
        _quad((right, half, 0), (right, -half, 0), (right, -half, height), (right, half, height)),
        _quad((left, half, height), (right, half, height), (right, -half, height), (left, -half, height)),
    ]
    for jamb in jambs:
        _on_wall(building, opening, jamb, pale)
    sill = _quad((left, -half, 0), (right, -half, 0), (right, half, 0), (left, half, 0))
    _on_wall(building, opening, sill, palette.woods[0] if opening.low == 0 else pale)
    if opening.kind == "window":
        pane = box(width, 0.01, height)
        _on_wall(building, opening, pane, palette.glass, whole=True)
        for fraction in np.linspace(0, 1, max(2, round(width / 0.8)) + 1):
            at = left + 0.02 + fraction * (width - 0.04)
            _on_wall(building, opening, box(0.04, 0.05, height).moved((float(at), 0.0, 0.0)), pale)
        for z in (0.0, height - 0.04):
            _on_wall(building, opening, box(width, 0.05, 0.04).moved((0.0, 0.0, z)), pale)


def _frame(building: Assembly, opening: Opening, finish: Finish) -> None:
    """Add the frame of an opening on both sides of the wall."""
    width, height, depth = opening.end - opening.start, opening.high - opening.low, WALL + 0.03
    for side in (-1, 1):
        board = box(FRAME, depth, height + FRAME).moved(
            (side * ((width + FRAME) / 2 - FRAME_OFFSET), 0.0, 0.0)
        )
        _on_wall(building, opening, board, finish)
    _on_wall(building, opening, box(width, depth, FRAME).moved((0.0, 0.0, height - FRAME_OFFSET)), finish)
    if opening.kind == "window":
        _on_wall(
            building, opening, box(width + 2 * FRAME, WALL + 0.14, 0.025).moved((0.0, 0.0, -0.025)), finish
        )


def _leaf(building: Assembly, opening: Opening, plan: Plan, wood: Finish, metal: Finish) -> None:
    """Add an open door leaf at right angles to the wall, outside corridors, unless it blocks another door."""
    first, second = opening.rooms
    inner = second if plan.rooms[first].kind == "corridor" else first
    room, width = plan.rooms[inner], opening.end - opening.start
    # the hinge is on the side of the nearer corner
    low, high = (room.x0, room.x1) if opening.axis == 0 else (room.y0, room.y1)
    hinge = -1.0 if opening.start - low < high - opening.end else 1.0
    swept = before(opening, room, width, 0.05)
    others = [other for other in plan.openings_of(inner) if other is not opening and other.kind != "window"]
    if any(swept.meets(before(other, room, 0.6, 0.1)) for other in others):
        return
    inside = (room.y0 > opening.at) if opening.axis == 0 else (room.x0 > opening.at)
    # in the frame of the opening y points north (axis 0) or west (axis 1)
    ahead = 1.0 if inside == (opening.axis == 0) else -1.0
    at = (hinge * (width / 2 - 0.02), ahead * WALL / 2, 0.0)
    leaf = box(0.04, width - 0.02, 1.98).moved((0.0, ahead * (width - 0.02) / 2, 0.02))
    _on_wall(building, opening, leaf.moved(at), wood)
    for side in (-0.03, 0.03):
        handle = box(0.03, 0.11, 0.02).moved((side, ahead * (width - 0.1), 1.0))
        _on_wall(building, opening, handle.moved(at), metal)
