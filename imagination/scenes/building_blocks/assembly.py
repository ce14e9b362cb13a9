"""Assembly of placed pieces into one mesh, its objects and a scene."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int32

from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.building_blocks.pieces import Piece, Placed
from imagination.scenes.free_space import free_space
from imagination.scenes.scene import Lighting, Mesh, OrientedBox, Scene, SceneObject


def assemble_scene(
    name: str,
    placed: Sequence[Placed],
    category_of: Callable[[str], str | None],
    robot_radius: float,
    lighting: Lighting | None = None,
    ceiling_height: float = 2.6,
) -> Scene:
    """Assemble placed pieces into a scene with its floor at height 0.

    Args:
        name: name of the scene.
        placed: the building, then the objects.
        category_of: function that returns the category of a label, or None.
        robot_radius: radius of the robot, metres.
        lighting: lighting of the scene; white ambient light if None.
        ceiling_height: height of the ceiling, metres.

    Raises:
        UserError: if the robot has no free space.
    """
    mesh = assemble(placed)
    free = free_space(mesh, 0.0, robot_radius)
    objects = tuple(
        object_of(instance, obj, category_of(obj.piece.label))
        for instance, obj in enumerate(placed)
        if instance > 0  # 0 is the building
    )
    return Scene(name, mesh, lighting or Lighting(), objects, free, 0.0, ceiling_height)


def assemble(objects: Sequence[Placed]) -> Mesh:
    """Assemble placed pieces into one mesh; the index of an object is its instance id."""
    pieces = [obj.piece for obj in objects]
    finishes: dict[int, Finish] = {id(finish): finish for piece in pieces for finish in piece.finishes}
    rows = {key: number for number, key in enumerate(finishes)}
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    return Mesh(
        np.concatenate([obj.points() for obj in objects]).astype(np.float32),
        np.concatenate(
            [piece.faces + start for piece, start in zip(pieces, starts[:-1], strict=True)]
        ).astype(np.int32),
        np.repeat(np.arange(len(pieces)), [len(piece.faces) for piece in pieces]).astype(np.int32),
        np.concatenate([_materials(piece, rows) for piece in pieces]),
        np.concatenate([_uv(piece) for piece in pieces]).astype(np.float32),
        tuple(finish.material for finish in finishes.values()),
    )


def _materials(piece: Piece, rows: dict[int, int]) -> Int32[np.ndarray, " m"]:
    """Return the index of the mesh material of each face of a piece."""
    return np.asarray(np.array([rows[id(finish)] for finish in piece.finishes], np.int32)[piece.face_finish])


def _uv(piece: Piece) -> Float[np.ndarray, "m 3 2"]:
    """Return the texture coordinates of each face in units of texture tiles."""
    tile = np.array([finish.tile for finish in piece.finishes])[piece.face_finish]
    return np.asarray(piece.uv / tile[:, None, None])


def object_of(instance: int, placed: Placed, category: str | None) -> SceneObject:
    """Return a placed piece as an object of the scene."""
    low, high = placed.piece.low, placed.piece.high
    origin = Placed(placed.piece, *((low + high)[:2] / 2).tolist()).within(placed.x, placed.y, placed.yaw)
    centre = (origin.x, origin.y, float(placed.z + (low[2] + high[2]) / 2))
    width, depth, height = (high - low).tolist()
    yaw = float(np.arctan2(np.sin(placed.yaw), np.cos(placed.yaw)))
    box = OrientedBox(centre, (width, depth, height), yaw)
    return SceneObject(instance, placed.piece.label, category, box, placed.piece.model)
