"""Preparation of furniture models: checked, rotated and scaled to the catalogue's size, in the frame of pieces."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.scene import Material
from imagination.utils.errors import UserError
from imagination_sweethome3d.archives import Archive
from imagination_sweethome3d.obj import ObjMaterial, ObjMesh, read_obj

MAX_STRETCH = 1.5
"""Maximum ratio of the scale factors of two axes."""
NOTED_STRETCH = 1.1
"""Ratio of scale factors above which a note is made."""
MAX_DEGENERATE = 0.5
"""Maximum fraction of triangles without area."""
MIN_OPACITY = 0.05
"""Opacity below which a surface is removed; other surfaces are drawn opaque."""
MAX_TRIANGLES = 65_000
"""Maximum number of triangles of a model."""

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
"""Ranges of width, depth and height of each label, metres."""


class UnfitError(UserError):
    """Model that cannot be used; the message is the reason."""


@dataclass(frozen=True, eq=False)
class Model:
    """Mesh in the frame of pieces: x to the right, y to the front, z up, origin on the floor below the centre.

    Attributes:
        vertices, faces, uv: triangles, metres, and their texture coordinates in repetitions of the texture.
        face_finish: row of `finishes` for each face.
        finishes: finishes of the surfaces.
        notes: defects and corrections.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: np.ndarray
    uv: np.ndarray
    face_finish: np.ndarray
    finishes: tuple[Finish, ...]
    notes: tuple[str, ...]


def check_size(label: str, size: tuple[float, float, float]) -> None:
    """Check that a size is within the range of its label.

    Raises:
        UnfitError: if a side is out of range.
    """
    for side, value, (low, high) in zip(("width", "depth", "height"), size, SIZES[label], strict=True):
        if not low <= value <= high:
            raise UnfitError(f"{side}: got {value:.2f} m, expected {low} to {high} m for {label}")


def read_model(archive: Archive, name: str) -> ObjMesh:
    """Read the mesh of a model.

    Raises:
        UnfitError: if the file is missing, malformed or not OBJ.
    """
    if not name.lower().endswith(".obj"):
        raise UnfitError(f"model: got {name}, expected an OBJ file")
    try:
        return read_obj(archive, name)
    except UserError as error:
        raise UnfitError(str(error)) from error


def fit_model(mesh: ObjMesh, size: tuple[float, float, float], rotation: Float[np.ndarray, "3 3"]) -> Model:
    """Rotate and scale a mesh to its size in the frame of pieces, and remove invisible faces.

    Args:
        mesh: mesh of the file.
        size: width, depth and height, metres.
        rotation: rotation of the mesh in the catalogue.

    Raises:
        UnfitError: if the mesh is invalid.
    """
    notes = [*mesh.notes]
    vertices = _scale(mesh, size, rotation, notes)
    visible = _visible_faces(mesh, vertices, notes)
    finishes, face_finish, uv = _finishes(mesh, visible)
    used, faces = np.unique(mesh.faces[visible], return_inverse=True)
    return Model(
        vertices[used].astype(np.float32),
        faces.reshape(-1, 3).astype(np.int32),
        uv.astype(np.float32),
        face_finish.astype(np.int32),
        finishes,
        tuple(notes),
    )


def _scale(
    mesh: ObjMesh, size: tuple[float, float, float], rotation: Float[np.ndarray, "3 3"], notes: list[str]
) -> Float[np.ndarray, "n 3"]:
    """Rotate vertices and scale them to the size, in the frame of pieces.

    The axes x, y, z of the catalogue become -x, z, y.
    """
    if len(mesh.faces) == 0:
        raise UnfitError("the mesh has no faces")
    if not np.isfinite(mesh.vertices).all():
        raise UnfitError("the mesh has vertices that are not finite")
    target = np.array([size[0], size[2], size[1]])
    options = [mesh.vertices @ rotation.T]
    if not np.allclose(rotation, np.eye(3), atol=1e-3):
        options.append(mesh.vertices)  # some meshes are rotated already
    ratios = [_stretch(vertices[mesh.faces.ravel()], target) for vertices in options]
    best = int(np.argmin(ratios)) if min(ratios) < 0.95 * ratios[0] else 0
    if ratios[best] > MAX_STRETCH:
        raise UnfitError(
            f"the size stretches the mesh {ratios[best]:.2f} times more along one axis than along another, expected "
            f"at most {MAX_STRETCH}"
        )
    if ratios[best] > NOTED_STRETCH:
        notes.append(f"stretched {ratios[best]:.2f} times more along one axis than along another")
    if best == 1:
        notes.append("the mesh is rotated already")
    vertices = options[best]
    corners = vertices[mesh.faces.ravel()]
    low, high = corners.min(axis=0), corners.max(axis=0)
    scaled = (vertices - (low + high) / 2) * (target / (high - low))
    return np.column_stack([-scaled[:, 0], scaled[:, 2], scaled[:, 1] + target[1] / 2])


def _stretch(corners: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "3"]) -> float:
    """Return the largest ratio of the scale factors of two axes; infinite for a flat mesh."""
    extent = corners.max(axis=0) - corners.min(axis=0)
    if (extent <= 0).any():
        return float("inf")
    factors = target / extent
    return float(factors.max() / factors.min())


def _visible_faces(mesh: ObjMesh, vertices: Float[np.ndarray, "n 3"], notes: list[str]) -> np.ndarray:
    """Return a mask of the faces that have an area and are not transparent."""
    corners = vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    solid = area > 1e-10
    if 1 - solid.mean() > MAX_DEGENERATE:
        raise UnfitError(
            f"{1 - solid.mean():.0%} of the triangles have no area, expected at most {MAX_DEGENERATE:.0%}"
        )
    if solid.sum() > MAX_TRIANGLES:
        raise UnfitError(f"got {solid.sum()} triangles, expected at most {MAX_TRIANGLES}")
    opacity = np.array([material.opacity for material in mesh.materials])[mesh.face_material]
    if (opacity < 1).any():
        notes.append(
            f"{(opacity < 1).sum()} of {len(opacity)} triangles are transparent and drawn opaque, "
            f"{(opacity < MIN_OPACITY).sum()} of them removed"
        )
    visible: np.ndarray = solid & (opacity >= MIN_OPACITY)
    if not visible.any():
        raise UnfitError("all faces are transparent")
    return visible


def _finishes(mesh: ObjMesh, visible: np.ndarray) -> tuple[tuple[Finish, ...], np.ndarray, np.ndarray]:
    """Return the materials in use as finishes, the row of each visible face, and its texture coordinates."""
    rows, face_finish = np.unique(mesh.face_material[visible], return_inverse=True)
    uv = mesh.uv[visible]
    finishes = []
    for number, row in enumerate(rows.tolist()):
        flat = not np.ptp(uv[face_finish == number].reshape(-1, 2), axis=0).any()
        finishes.append(Finish(material_of(mesh.materials[row], flat)))
    return tuple(finishes), face_finish, uv


def material_of(material: ObjMaterial, flat: bool) -> Material:
    """Convert a material; a texture without coordinates (`flat`) becomes its mean colour."""
    if material.texture is None:
        return Material(material.colour)
    if flat:
        red, green, blue = (material.texture.mean(axis=(0, 1)) / 255).tolist()
        return Material((red, green, blue))
    return Material((1.0, 1.0, 1.0), material.texture)
