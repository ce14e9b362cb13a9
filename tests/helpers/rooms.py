"""A small hand-made furnished room, for tests that need a whole scene without a scene source."""

from itertools import product

import numpy as np

from imagination.scenes.free_space import free_space
from imagination.scenes.scene import Lighting, Material, Mesh, OrientedBox, Scene, SceneObject

BUILDING, TABLE, CHAIR, BED, LAMP = range(5)
COLOURS = ((0.8, 0.8, 0.75), (0.6, 0.4, 0.2), (0.2, 0.3, 0.7), (0.7, 0.2, 0.3), (0.9, 0.9, 0.4))
ROBOT_RADIUS = 0.18


class MeshBuilder:
    """Builder of a mesh of boxes and quadrilaterals; instance i has colour COLOURS[i % 5]."""

    def __init__(self) -> None:
        self._quads: list[np.ndarray] = []
        self._owner: list[int] = []

    def quad(self, corners: np.ndarray, instance: int) -> None:
        """Add a quadrilateral; its corners are counter-clockwise as seen from the side of the normal."""
        self._quads.append(np.asarray(corners, np.float64))
        self._owner.append(instance)

    def box(self, low: tuple[float, float, float], high: tuple[float, float, float], instance: int) -> None:
        """Add an axis-aligned box with its normals pointing outwards."""
        corner = np.array(list(product(*zip(low, high, strict=True))))
        for side in ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)):
            self.quad(corner[list(side)], instance)

    def build(self, turn: float = 0.0, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
        """Build the mesh, rotated counter-clockwise about z, then shifted; texture coordinates span each quad."""
        count = len(self._quads)
        cos, sin = np.cos(turn), np.sin(turn)
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        vertices = np.concatenate(self._quads) @ rotation.T + np.array(shift)
        faces = (np.arange(count)[:, None, None] * 4 + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        owner = np.repeat(self._owner, 2).astype(np.int32)
        corner_uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        return Mesh(
            vertices.astype(np.float32),
            faces.astype(np.int32),
            owner,
            owner % np.int32(len(COLOURS)),
            np.tile(corner_uv[[[0, 1, 2], [0, 2, 3]]], (count, 1, 1)),
            tuple(Material(colour) for colour in COLOURS),
        )


def tiny_room(
    size: tuple[float, float] = (5.0, 4.0),
    turn: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
    floor_height: float = 0.0,
    wall: float = 0.1,
) -> Scene:
    """Build a room, centred on the origin, with a table, a chair half under it, a bed and a lamp without category.

    Seen from above before `turn` (counter-clockwise, radians) and `shift`, x to the right: the table is at the upper
    left, the chair at its lower long side, the bed along the right wall, the lamp in the lower left corner.
    """
    half_x, half_y, height = size[0] / 2, size[1] / 2, 2.6
    builder = MeshBuilder()
    builder.quad(
        [[-half_x, -half_y, 0], [half_x, -half_y, 0], [half_x, half_y, 0], [-half_x, half_y, 0]], BUILDING
    )
    builder.quad(
        [
            [-half_x, -half_y, height],
            [-half_x, half_y, height],
            [half_x, half_y, height],
            [half_x, -half_y, height],
        ],
        BUILDING,
    )
    builder.box((-half_x - wall, -half_y - wall, 0), (half_x + wall, -half_y, height), BUILDING)
    builder.box((-half_x - wall, half_y, 0), (half_x + wall, half_y + wall, height), BUILDING)
    builder.box((-half_x - wall, -half_y, 0), (-half_x, half_y, height), BUILDING)
    builder.box((half_x, -half_y, 0), (half_x + wall, half_y, height), BUILDING)

    boxes = {
        TABLE: ("table", "table", (-1.9, 0.6, 0.0), (-0.5, 1.4, 0.75)),
        CHAIR: ("chair", "chair", (-1.4, 0.2, 0.0), (-0.95, 0.65, 0.9)),
        BED: ("bed", "bed", (half_x - 1.5, -1.6, 0.0), (half_x, 0.4, 0.9)),
        LAMP: ("lamp", None, (-2.3, -1.8, 0.0), (-2.0, -1.5, 1.6)),
    }
    (x0, y0, _), (x1, y1, _) = boxes[TABLE][2:]
    builder.box((x0, y0, 0.71), (x1, y1, 0.75), TABLE)
    for x, y in ((x0, y0), (x1 - 0.06, y0), (x0, y1 - 0.06), (x1 - 0.06, y1 - 0.06)):
        builder.box((x, y, 0.0), (x + 0.06, y + 0.06, 0.71), TABLE)
    (x0, y0, _), (x1, y1, _) = boxes[CHAIR][2:]
    builder.box((x0, y0, 0.42), (x1, y1, 0.46), CHAIR)
    builder.box((x0, y0, 0.46), (x1, y0 + 0.04, 0.9), CHAIR)
    for x, y in ((x0, y0), (x1 - 0.04, y0), (x0, y1 - 0.04), (x1 - 0.04, y1 - 0.04)):
        builder.box((x, y, 0.0), (x + 0.04, y + 0.04, 0.42), CHAIR)
    (x0, y0, _), (x1, y1, _) = boxes[BED][2:]
    builder.box((x0, y0, 0.0), (x1, y1, 0.5), BED)
    builder.box((x0, y1 - 0.05, 0.5), (x1, y1, 0.9), BED)
    builder.box(*boxes[LAMP][2:], LAMP)

    mesh = builder.build(turn, (*shift, floor_height))
    cos, sin = np.cos(turn), np.sin(turn)
    objects = []
    for instance, (label, category, low, high) in boxes.items():
        x, y, z = (np.array(low) + np.array(high)) / 2
        centre = (
            float(cos * x - sin * y + shift[0]),
            float(sin * x + cos * y + shift[1]),
            float(z + floor_height),
        )
        extent = tuple((np.array(high) - np.array(low)).tolist())
        objects.append(SceneObject(instance, label, category, OrientedBox(centre, extent, turn)))
    lighting = Lighting(
        (0.5, 0.5, 0.5),
        np.array([[0.48, 0.36, 0.8], [-0.6, 0.0, 0.8]], np.float32),
        np.array([[0.4, 0.4, 0.35], [0.15, 0.15, 0.2]], np.float32),
    )
    free = free_space(mesh, floor_height, ROBOT_RADIUS)
    return Scene("tiny", mesh, lighting, tuple(objects), free, floor_height, floor_height + height)
