"""Furniture models made ready: oriented, scaled to the catalogue's size, checked, in the frame of pieces."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.scene import Material
from imagination.utils.errors import UserError
from imagination_sweethome3d.archives import Archive
from imagination_sweethome3d.obj import Look, ObjMesh, read_obj

UNEVEN = 1.5
"""Most that a mesh may be stretched along one axis against another."""
NOTED = 1.1
"""Stretch from which it is noted."""
DEGENERATE = 0.5
"""Largest share of triangles without area."""
CLEAR = 0.05
"""Opacity below which a surface is left out; others are drawn solid."""
MAX_TRIANGLES = 65_000

Range = tuple[float, float]

SIZES: Mapping[str, tuple[Range, Range, Range]] = {
    "chair": ((0.25, 1.0), (0.25, 1.0), (0.45, 1.4)),
    "office_chair": ((0.4, 0.9), (0.4, 0.9), (0.75, 1.4)),
    "armchair": ((0.45, 1.3), (0.45, 1.6), (0.55, 1.3)),
    "dining_table": ((0.6, 2.6), (0.5, 1.8), (0.6, 1.1)),
    "desk": ((0.6, 2.4), (0.4, 1.2), (0.6, 1.9)),
    "coffee_table": ((0.4, 2.1), (0.35, 1.6), (0.2, 0.65)),
    "side_table": ((0.25, 0.7), (0.25, 0.7), (0.3, 0.75)),
    "double_bed": ((1.2, 2.4), (1.6, 2.4), (0.15, 1.7)),
    "single_bed": ((0.6, 2.3), (0.6, 2.4), (0.3, 1.4)),
    "bunk_bed": ((0.7, 2.2), (0.7, 2.7), (1.2, 2.3)),
    "sofa": ((1.1, 3.6), (0.6, 2.0), (0.45, 1.2)),
    "stool": ((0.25, 1.0), (0.25, 1.0), (0.35, 1.15)),
    "bench": ((0.7, 1.8), (0.3, 0.6), (0.35, 0.9)),
    "nightstand": ((0.25, 0.7), (0.25, 0.6), (0.3, 0.8)),
    "wardrobe": ((0.6, 2.4), (0.4, 0.8), (1.6, 2.4)),
    "dresser": ((0.5, 1.8), (0.35, 0.7), (0.5, 1.3)),
    "shelf": ((0.4, 1.8), (0.2, 0.6), (0.7, 2.3)),
    "sideboard": ((0.6, 2.2), (0.3, 0.7), (0.6, 1.6)),
    "tv_stand": ((0.6, 2.2), (0.3, 0.7), (0.25, 0.8)),
    "fridge": ((0.45, 1.0), (0.5, 1.0), (0.8, 2.1)),
    "toilet": ((0.3, 0.6), (0.4, 0.9), (0.4, 1.1)),
    "basin": ((0.3, 1.2), (0.3, 0.8), (0.7, 1.1)),
    "bath": ((1.2, 1.9), (0.6, 1.2), (0.4, 0.9)),
    "floor_lamp": ((0.1, 0.9), (0.1, 0.9), (1.0, 2.0)),
    "plant": ((0.2, 1.2), (0.2, 1.2), (0.35, 2.0)),
}
"""Widths, depths and heights that each label may have, metres; what lies outside is no such furniture, or a toy."""


class UnfitError(UserError):
    """A model that is left out; the message is the reason."""


@dataclass(frozen=True, eq=False)
class Model:
    """A mesh in the frame of pieces: x to the right, y to the front, z up, origin on the floor under its middle.

    Attributes:
        vertices, faces, uv: triangles, metres; texture coordinates in copies of the texture.
        face_finish: row of `finishes` for each face.
        finishes: looks.
        notes: what it lacked.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: np.ndarray
    uv: np.ndarray
    face_finish: np.ndarray
    finishes: tuple[Finish, ...]
    notes: tuple[str, ...]


def check_size(label: str, size: tuple[float, float, float]) -> None:
    """Refuse what cannot be a thing of this label.

    Raises:
        UnfitError: with the side that is out of range.
    """
    for side, value, (low, high) in zip(("width", "depth", "height"), size, SIZES[label], strict=True):
        if not low <= value <= high:
            raise UnfitError(f"its {side} is {value:.2f} m, expected {low} to {high} m for {label}")


def read_model(archive: Archive, name: str) -> ObjMesh:
    """The mesh of a model as its file has it.

    Raises:
        UnfitError: if it is no OBJ file, missing or malformed.
    """
    if not name.lower().endswith(".obj"):
        raise UnfitError(f"its model {name} is no OBJ file")
    try:
        return read_obj(archive, name)
    except UserError as error:
        raise UnfitError(str(error)) from error


def fitted(mesh: ObjMesh, size: tuple[float, float, float], turn: Float[np.ndarray, "3 3"]) -> Model:
    """A mesh made ready.

    Args:
        mesh: as its file has it.
        size: width, depth and height of the catalogue, metres.
        turn: the catalogue's rotation of the mesh.

    Raises:
        UnfitError: if it is not sane, with the reason.
    """
    notes = [*mesh.notes]
    vertices = _scaled(mesh, size, turn, notes)
    kept = _kept_faces(mesh, vertices, notes)
    finishes, face_finish, uv = _finishes(mesh, kept)
    used, faces = np.unique(mesh.faces[kept], return_inverse=True)
    return Model(
        vertices[used].astype(np.float32),
        faces.reshape(-1, 3).astype(np.int32),
        uv.astype(np.float32),
        face_finish.astype(np.int32),
        finishes,
        tuple(notes),
    )


def _scaled(
    mesh: ObjMesh, size: tuple[float, float, float], turn: Float[np.ndarray, "3 3"], notes: list[str]
) -> Float[np.ndarray, "n 3"]:
    """Vertices turned, stretched to the size and stood up, y to the front (catalogue's z) and x accordingly to -x."""
    if len(mesh.faces) == 0:
        raise UnfitError("its mesh has no faces")
    if not np.isfinite(mesh.vertices).all():
        raise UnfitError("its mesh has vertices that are not finite")
    wanted = np.array([size[0], size[2], size[1]])
    turned = mesh.vertices @ turn.T
    choices = [turned]
    if not np.allclose(turn, np.eye(3), atol=1e-3):
        choices.append(mesh.vertices)  # in some the rotation is already in the mesh
    spreads = [_stretch(vertices[mesh.faces.ravel()], wanted) for vertices in choices]
    best = int(np.argmin(spreads)) if min(spreads) < 0.95 * spreads[0] else 0
    if spreads[best] > UNEVEN:
        raise UnfitError(
            f"the catalogue's size stretches its mesh {spreads[best]:.2f} times more along one axis than along "
            f"another, expected at most {UNEVEN}"
        )
    if spreads[best] > NOTED:
        notes.append(f"it is stretched {spreads[best]:.2f} times more along one axis than along another")
    if best == 1:
        notes.append("the catalogue's rotation is already in the mesh")
    vertices = choices[best]
    corners = vertices[mesh.faces.ravel()]
    low, high = corners.min(axis=0), corners.max(axis=0)
    standing = (vertices - (low + high) / 2) * (wanted / (high - low))
    return np.column_stack([-standing[:, 0], standing[:, 2], standing[:, 1] + wanted[1] / 2])


def _stretch(corners: Float[np.ndarray, "n 3"], wanted: Float[np.ndarray, "3"]) -> float:
    """How unevenly the mesh would be scaled; infinite if it is flat."""
    extent = corners.max(axis=0) - corners.min(axis=0)
    if (extent <= 0).any():
        return float("inf")
    factors = wanted / extent
    return float(factors.max() / factors.min())


def _kept_faces(mesh: ObjMesh, vertices: Float[np.ndarray, "n 3"], notes: list[str]) -> np.ndarray:
    """Faces that have an area and can be seen."""
    corners = vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    solid = area > 1e-10
    if 1 - solid.mean() > DEGENERATE:
        raise UnfitError(f"{1 - solid.mean():.0%} of its triangles have no area")
    if solid.sum() > MAX_TRIANGLES:
        raise UnfitError(f"it has {solid.sum()} triangles, expected at most {MAX_TRIANGLES}")
    opacity = np.array([look.opacity for look in mesh.looks])[mesh.face_look]
    if (opacity < 1).any():
        notes.append(
            f"{(opacity < 1).sum()} of {len(opacity)} triangles are transparent and are drawn solid, "
            f"{(opacity < CLEAR).sum()} of them left out"
        )
    kept: np.ndarray = solid & (opacity >= CLEAR)
    if not kept.any():
        raise UnfitError("all of it is transparent")
    return kept


def _finishes(mesh: ObjMesh, kept: np.ndarray) -> tuple[tuple[Finish, ...], np.ndarray, np.ndarray]:
    """Looks in use as finishes, the row of each kept face, its texture coordinates."""
    rows, face_finish = np.unique(mesh.face_look[kept], return_inverse=True)
    uv = mesh.uv[kept]
    finishes = []
    for number, row in enumerate(rows.tolist()):
        flat = not np.ptp(uv[face_finish == number].reshape(-1, 2), axis=0).any()
        finishes.append(Finish(material_of(mesh.looks[row], flat)))
    return tuple(finishes), face_finish, uv


def material_of(look: Look, flat: bool) -> Material:
    """A look as material; a texture whose coordinates are missing (`flat`) gives its mean colour."""
    if look.texture is None:
        return Material(look.colour)
    if flat:
        red, green, blue = (look.texture.mean(axis=(0, 1)) / 255).tolist()
        return Material((red, green, blue))
    return Material((1.0, 1.0, 1.0), look.texture)
