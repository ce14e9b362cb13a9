"""Parser of Sweet Home 3D homes: walls, rooms, openings and furniture of each level, in metres.

The plan of a file has x to the right and y down, with clockwise angles; here y is up and angles are counter-clockwise.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from imagination.utils.errors import UserError
from imagination_sweethome3d.archives import MAX_TEXT, open_archive

HOME = "Home.xml"
FURNITURE = ("pieceOfFurniture", "light", "shelfUnit", "doorOrWindow")
COUNTED_TAGS = frozenset(("level", "wall", "room", "point", "furnitureGroup", *FURNITURE))
PLAIN_FLOOR = 0.78, 0.76, 0.72
"""Colour of floors without one, RGB in [0, 1]."""
CENTIMETRE = 0.01
MAX_LENGTH = 1000.0
"""Maximum coordinate and side length, metres."""
MAX_ITEMS = 20_000
"""Maximum number of levels, walls, rooms, points of rooms and pieces of furniture of a home."""

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Wall:
    """Straight wall segment from start to end of its centre line, metres."""

    start: tuple[float, float]
    end: tuple[float, float]
    thickness: float
    height: float
    colour: Colour


@dataclass(frozen=True)
class Room:
    """Polygon with a floor and, usually, a ceiling."""

    outline: tuple[tuple[float, float], ...]
    floor: Colour
    ceiling: Colour
    has_ceiling: bool


@dataclass(frozen=True)
class HomePiece:
    """Piece of furniture, or a door or window in an opening.

    Attributes:
        catalogue_id, name, model: values of the file.
        centre: x and y of the centre, metres.
        elevation: height of the bottom above the floor of the level, metres.
        yaw: angle of the x axis, radians.
        size: width, depth and height, metres.
        pitch, roll: tilt about the width axis or about the depth axis, radians; roll is ignored if there is a pitch.
        mirrored: whether the model is mirrored left to right.
        model_rotation: rotation of the model, nine numbers by rows.
        opening: whether the piece is a door or window, which belongs into a wall.
        colour: colour that replaces those of the model, or None.
        creator, licence: author and licence of the model, empty if the file does not name them.
    """

    catalogue_id: str
    name: str
    model: str
    centre: tuple[float, float]
    elevation: float
    yaw: float
    size: tuple[float, float, float]
    pitch: float
    roll: float
    mirrored: bool
    model_rotation: tuple[float, ...]
    opening: bool
    colour: Colour | None
    creator: str
    licence: str

    @property
    def key(self) -> str:
        """Identifier of the model."""
        return self.catalogue_id or self.model or self.name


@dataclass(frozen=True)
class Level:
    """Level of a home: elevation of its floor and height of its walls, metres."""

    name: str
    elevation: float
    height: float
    walls: tuple[Wall, ...]
    rooms: tuple[Room, ...]
    pieces: tuple[HomePiece, ...]

    @property
    def openings(self) -> tuple[HomePiece, ...]:
        return tuple(piece for piece in self.pieces if piece.opening)

    @property
    def furniture(self) -> tuple[HomePiece, ...]:
        return tuple(piece for piece in self.pieces if not piece.opening)


def read_home(path: Path) -> tuple[Level, ...]:
    """Read the furnished levels of a home that have rooms or walls.

    Raises:
        UserError: if the file is not a home, has an older format, is damaged, or has no furniture.
    """
    with open_archive(path) as archive:
        if HOME not in archive:
            if "Home" in archive:  # serialised Java
                raise UserError(
                    f"{path}: has no {HOME}, written by Sweet Home 3D before 5.3; open it in a newer version and save "
                    "it again"
                )
            raise UserError(f"{path}: has no {HOME}, expected a home of Sweet Home 3D (.sh3d)")
        root = parse_xml(archive.read(HOME, MAX_TEXT), f"{path}: {HOME}")
    if root.tag != "home":
        raise UserError(f"{path}: {HOME} holds <{root.tag}>, expected <home>")
    try:
        levels = _levels(root)
    except (KeyError, ValueError) as error:
        raise UserError(f"{path}: {HOME} is invalid: {error}") from error
    usable = tuple(level for level in levels if level.furniture and (level.rooms or level.walls))
    if not usable:
        raise UserError(
            f"{path}: none of {len(levels)} levels has furniture and a room or walls; furnish it in Sweet Home 3D"
        )
    return usable


def parse_xml(content: bytes, where: str) -> Element:
    """Parse XML without a document type, so that no entity can be defined or fetched.

    Raises:
        UserError: if the XML is malformed or declares a document type.
    """
    builder, parser = TreeBuilder(), expat.ParserCreate()

    def refuse(*_: object) -> None:
        raise UserError(
            f"{where}: declares a document type, which is not allowed in a home; the file is not read"
        )

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(content, True)
        return builder.close()
    except UserError:
        raise
    except (
        expat.ExpatError,
        AssertionError,
        LookupError,
        ValueError,
    ) as error:  # the last two are raised for unknown encodings
        raise UserError(f"{where} is damaged: {error}") from error


def _levels(root: Element) -> list[Level]:
    count = sum(node.tag in COUNTED_TAGS for node in root.iter())
    if count > MAX_ITEMS:
        raise ValueError(
            f"got {count} levels, walls, rooms, points and pieces of furniture, expected at most {MAX_ITEMS}"
        )
    known: dict[str, Element | None] = {node.attrib["id"]: node for node in root.findall("level")} or {
        "": None
    }
    elevations = {key: 0.0 if node is None else _length(node, "elevation") for key, node in known.items()}
    ground = min(known, key=lambda key: abs(elevations[key]))
    wall_height = _length(root, "wallHeight", 250.0)
    walls: dict[str, list[Wall]] = {key: [] for key in known}
    rooms: dict[str, list[Room]] = {key: [] for key in known}
    pieces: dict[str, list[HomePiece]] = {key: [] for key in known}
    for child, level in _items(root):
        key = level if level in known else ground  # items without a known level belong to the ground floor
        if child.tag == "wall":
            walls[key] += _walls(child, wall_height)
        elif child.tag == "room":
            rooms[key] += [room for room in [_room(child)] if len(room.outline) > 2]
        else:
            pieces[key].append(_piece(child))
    return [
        Level(
            "" if node is None else node.get("name", key),
            elevations[key],
            max(
                (wall.height for wall in walls[key]),
                default=wall_height if node is None else _length(node, "height", 250.0),
            ),
            tuple(walls[key]),
            tuple(rooms[key]),
            tuple(pieces[key]),
        )
        for key, node in known.items()
    ]


def _items(root: Element) -> Iterator[tuple[Element, str]]:
    """Yield walls, rooms and visible furniture with their levels, groups expanded in place.

    Pieces of a group have positions in the plan; those without a level are on the level of the group.
    """
    waiting = [(child, "") for child in reversed(root)]
    while waiting:
        node, group_level = waiting.pop()
        level = node.get("level", group_level)
        if node.tag in ("wall", "room"):
            yield node, level
        elif node.get("visible", "true") == "false":
            continue
        elif node.tag == "furnitureGroup":
            waiting += [(child, level) for child in reversed(node)]
        elif node.tag in FURNITURE:
            yield node, level


def _walls(node: Element, wall_height: float) -> list[Wall]:
    """Return the segments of a wall: one, or eight along an arc."""
    ends = [
        np.array([_length(node, f"x{end}", None), -_length(node, f"y{end}", None)])
        for end in ("Start", "End")
    ]
    height = max(_length(node, "height", wall_height / CENTIMETRE), _length(node, "heightAtEnd", 0.0))
    thickness = _length(node, "thickness", 7.5)
    colour = _colour(node.get("leftSideColor") or node.get("rightSideColor")) or (0.93, 0.92, 0.9)
    if not 0 < thickness < 5 or not 0 < height < 50:
        raise ValueError(
            f"got a wall {thickness} m thick and {height} m high, expected (0, 5) m and (0, 50) m"
        )
    points = _along_arc(*ends, float(node.get("arcExtent", 0.0)))
    return [
        Wall((float(a[0]), float(a[1])), (float(b[0]), float(b[1])), thickness, height, colour)
        for a, b in zip(points[:-1], points[1:], strict=True)
        if np.hypot(*(b - a)) > 1e-4
    ]


def _along_arc(start: np.ndarray, end: np.ndarray, extent: float) -> list[np.ndarray]:
    """Return points from start to end on an arc of `extent` radians, positive counter-clockwise on the plan."""
    if abs(extent) < 1e-3 or not abs(extent) < 2 * np.pi:
        return [start, end]
    chord = end - start
    turn = -extent  # the y axis of the plan points down
    centre = (start + end) / 2 + np.array([-chord[1], chord[0]]) / (2 * np.tan(turn / 2))
    arm = start - centre
    angles = np.linspace(0, turn, 9)
    return [
        centre + np.array([np.cos(a) * arm[0] - np.sin(a) * arm[1], np.sin(a) * arm[0] + np.cos(a) * arm[1]])
        for a in angles
    ]


def _room(node: Element) -> Room:
    outline = tuple(
        (_length(point, "x", None), -_length(point, "y", None)) for point in node.findall("point")
    )
    return Room(
        outline,
        _colour(node.get("floorColor")) or PLAIN_FLOOR,
        _colour(node.get("ceilingColor")) or (0.97, 0.97, 0.96),
        node.get("ceilingVisible", "true") != "false",
    )


def _piece(node: Element) -> HomePiece:
    width, depth, height = (_length(node, side, None) for side in ("width", "depth", "height"))
    if not all(0 < side < MAX_LENGTH for side in (width, depth, height)):
        raise ValueError(
            f"size of {node.get('name')!r}: got {width} x {depth} x {height} m, expected sides in (0, {MAX_LENGTH}) m"
        )
    rotation = tuple(float(value) for value in node.get("modelRotation", "1 0 0 0 1 0 0 0 1").split())
    if len(rotation) != 9 or not np.isfinite(rotation).all():
        raise ValueError(
            f"modelRotation of {node.get('name')!r}: got {rotation}, expected nine finite numbers"
        )
    return HomePiece(
        node.get("catalogId", ""),
        node.get("name", ""),
        node.get("model", ""),
        (_length(node, "x", None), -_length(node, "y", None)),
        _length(node, "elevation"),
        -_number(node, "angle", 0.0),
        (width, depth, height),
        _number(node, "pitch", 0.0),
        _number(node, "roll", 0.0),
        node.get("modelMirrored") == "true",
        rotation,
        node.tag == "doorOrWindow",
        _colour(node.get("color")),
        node.get("creator", ""),
        node.get("license", ""),
    )


def _length(node: Element, name: str, default: float | None = 0.0) -> float:
    """Return an attribute in centimetres as metres."""
    value = _number(node, name, default) * CENTIMETRE
    if not abs(value) <= MAX_LENGTH:
        raise ValueError(
            f"<{node.tag}> {name}: got {node.get(name)!r}, expected at most {MAX_LENGTH / CENTIMETRE:g} cm"
        )
    return value


def _number(node: Element, name: str, default: float | None) -> float:
    text = node.get(name)
    if text is None:
        if default is None:
            raise ValueError(f"<{node.tag}> has no {name}")
        return default
    value = float(text)
    if not np.isfinite(value):
        raise ValueError(f"<{node.tag}> {name}: got {text!r}, expected a finite number")
    return value


def _colour(text: str | None) -> Colour | None:
    """Return RGB in [0, 1] of six or eight hexadecimal digits."""
    if not text:
        return None
    number = int(text, 16)
    red, green, blue = ((number >> shift & 255) / 255 for shift in (16, 8, 0))
    return red, green, blue
