"""Pieces put together into one mesh."""

import numpy as np
from jaxtyping import Float, Int32

from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.building_blocks.pieces import Piece, Placed
from imagination.scenes.scene import Mesh, OrientedBox, SceneObject


def assemble(things: list[Placed]) -> Mesh:
    """One mesh of all things; a thing's number is its instance id."""
    pieces = [thing.piece for thing in things]
    finishes: dict[int, Finish] = {id(finish): finish for piece in pieces for finish in piece.finishes}
    row = {key: number for number, key in enumerate(finishes)}
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    return Mesh(
        np.concatenate([thing.points() for thing in things]).astype(np.float32),
        np.concatenate(
            [piece.faces + start for piece, start in zip(pieces, starts[:-1], strict=True)]
        ).astype(np.int32),
        np.repeat(np.arange(len(pieces)), [len(piece.faces) for piece in pieces]).astype(np.int32),
        np.concatenate([_rows(piece, row) for piece in pieces]),
        np.concatenate([_uv(piece) for piece in pieces]).astype(np.float32),
        tuple(finish.material for finish in finishes.values()),
    )


def _rows(piece: Piece, row: dict[int, int]) -> Int32[np.ndarray, " m"]:
    """The mesh's material of each face of a piece."""
    return np.asarray(np.array([row[id(finish)] for finish in piece.finishes], np.int32)[piece.face_finish])


def _uv(piece: Piece) -> Float[np.ndarray, "m 3 2"]:
    """Texture coordinates in copies of the texture."""
    tile = np.array([finish.tile for finish in piece.finishes])[piece.face_finish]
    return np.asarray(piece.uv / tile[:, None, None])


def object_of(instance: int, thing: Placed, category: str | None) -> SceneObject:
    """A placed thing as an object of the scene."""
    low, high = thing.piece.low, thing.piece.high
    middle = Placed(thing.piece, *((low + high)[:2] / 2).tolist()).within(thing.x, thing.y, thing.yaw)
    centre = (middle.x, middle.y, float(thing.z + (low[2] + high[2]) / 2))
    width, depth, height = (high - low).tolist()
    yaw = float(np.arctan2(np.sin(thing.yaw), np.cos(thing.yaw)))
    box = OrientedBox(centre, (width, depth, height), yaw)
    return SceneObject(instance, thing.piece.label, category, box, thing.piece.model)
