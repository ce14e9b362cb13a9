"""HM3D: `<id>.semantic.glb`, whose textures have a unique colour per object, and `<id>.semantic.txt`."""

import csv
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from imagination.scenes.scene import Material
from imagination.scenes.source import Split
from imagination.utils.errors import UserError, require_extra
from imagination_scans.building import GREY, Building, ScannedObject, check_building, colour_texture
from imagination_scans.layouts import check_id, hash_fraction, split_lists

log = logging.getLogger(__name__)

HEADER = "HM3D Semantic Annotations"
COLOUR = re.compile(r"[0-9A-Fa-f]{6}")
TOLERANCE = 0.001
"""Maximum distance of corresponding corners in the two meshes, metres."""


class HM3D:
    """Layout with folders train and val of `<number>-<id>`.

    Each holds `<id>.semantic.glb`, `<id>.semantic.txt` and, for colour, `<id>.glb`.
    """

    name = "hm3d"
    expected = (
        "train/<number>-<id>/<id>.semantic.glb, <id>.semantic.txt and, for colours, <id>.glb (the archives "
        "hm3d-…-semantic-annots and hm3d-…-glb)"
    )

    def buildings(self, folder: Path) -> dict[str, Path]:
        buildings = {path.name.partition(".")[0]: path for path in sorted(folder.rglob("*.semantic.txt"))}
        if not buildings:
            raise UserError(f"hm3d: found no .semantic.txt in {folder.resolve()}; expected {self.expected}")
        return buildings

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        """Return the splits by lists hm3d_train.txt, … in the folder, else by the folders train and val.

        The official test split has no annotation, so about half of val is for test, by a hash of each name. minival is
        a part of val.
        """
        by_folder: dict[str, Split] = {}
        for name, path in self.buildings(folder).items():
            match path.resolve().parent.parent.name:
                case "train":
                    by_folder[name] = "train"
                case "val" | "minival":
                    by_folder[name] = "test" if hash_fraction(name) < 0.5 else "val"
        return split_lists(folder, "hm3d_{split}.txt") or by_folder

    def files(self, building: Path) -> list[Path]:
        semantic, colour = self._meshes(building)
        if not semantic.is_file():
            raise UserError(f"{building.parent}: has {building.name} but no {semantic.name}")
        return [path for path in (building, semantic, colour) if path.is_file()]

    def read(self, building: Path) -> Building:
        by_colour = read_annotation(building)
        semantic_path, colour_path = self._meshes(building)
        parts = _parts(semantic_path)
        semantic_colours = np.concatenate([_face_colours(part) for part in parts])
        codes = (semantic_colours.astype(np.int64) * [65536, 256, 1]).sum(axis=1)
        colours, rows = np.unique(codes, return_inverse=True)
        ids = np.array([by_colour[c].id if c in by_colour else 0 for c in colours.tolist()], np.int32)
        vertices, faces = _concatenate(parts)
        materials, face_material, face_uv = _surface_materials(colour_path, parts)
        objects = tuple(by_colour.values())
        result = Building(vertices, faces, ids[rows], face_material, face_uv, materials, objects)
        check_building(result, str(building))
        return result

    def _meshes(self, building: Path) -> tuple[Path, Path]:
        """Return the paths of the semantic mesh and the colour mesh."""
        stem = building.name.partition(".")[0]
        return building.with_name(f"{stem}.semantic.glb"), building.with_name(f"{stem}.glb")


def read_annotation(path: Path) -> dict[int, ScannedObject]:
    """Read the objects of a `.semantic.txt` by their colour as a number, 0xRRGGBB.

    Raises:
        UserError: if the file is malformed; the message names the line.
    """
    try:
        lines = path.read_text().splitlines()
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is not a text file, expected {HEADER}") from error
    if not lines or lines[0].strip() != HEADER:
        raise UserError(f"{path}, line 1: got {(lines or [''])[0][:40]!r}, expected {HEADER!r}")
    objects: dict[int, ScannedObject] = {}
    taken: set[int] = set()
    for number, line in enumerate(lines[1:], start=2):
        if not line.strip():
            continue
        try:
            id, colour, name, _ = next(csv.reader([line]))
            if not COLOUR.fullmatch(colour):
                raise ValueError(f"the colour {colour!r}")
            taken.add(check_id(int(id), taken, minimum=1))
        except (ValueError, csv.Error) as error:
            raise UserError(
                f"{path}, line {number}: got {line[:60]!r}, expected an id, a colour of six hexadecimal "
                f'digits, a name in quotes and a region, as in 1,C7D5C5,"chair",0 ({error})'
            ) from error
        if int(colour, 16) in objects:
            raise UserError(
                f"{path}, line {number}: the colour {colour} occurs twice, expected a unique colour per object"
            )
        objects[int(colour, 16)] = ScannedObject(int(id), name.strip())
    return objects


class Part(NamedTuple):
    """Mesh of a GLB file and its texture, or None."""

    mesh: Any
    image: np.ndarray | None

    def corners(self) -> np.ndarray:
        """Return the corners of the triangles (m, 3, 3), metres."""
        return np.asarray(self.mesh.vertices[self.mesh.faces], np.float32)


def _parts(path: Path) -> list[Part]:
    """Read the meshes of a GLB file in world coordinates, z up.

    Raises:
        UserError: if trimesh is not installed or the file is malformed.
    """
    require_extra("trimesh", "scans")
    import trimesh

    try:
        scene = trimesh.load_scene(path, process=False)
        meshes = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
        parts = [Part(mesh, _image(mesh.visual)) for mesh in meshes]
        for part in parts:
            _check_part(part)
    except Exception as error:  # trimesh documents no exceptions
        raise UserError(f"{path}: cannot be read as GLB: {type(error).__name__}: {error}") from error
    if not parts:
        raise UserError(f"{path}: contains no mesh")
    return parts


def _check_part(part: Part) -> None:
    """Check what trimesh does not check: indices, shapes and finite values.

    Raises:
        ValueError: if the mesh is invalid.
    """
    mesh, count = part.mesh, len(part.mesh.vertices)
    if mesh.faces.shape[1:] != (3,) or mesh.faces.min() < 0 or mesh.faces.max() >= count:
        raise ValueError(f"faces refer to vertices {mesh.faces.min()} to {mesh.faces.max()}, of {count}")
    if mesh.vertices.shape[1:] != (3,) or not np.isfinite(mesh.vertices).all():
        raise ValueError("vertices that are not finite")
    if part.image is not None and np.shape(mesh.visual.uv) != (count, 2):
        raise ValueError(f"{np.shape(mesh.visual.uv)} texture coordinates for {count} vertices")
    if part.image is not None and not np.isfinite(mesh.visual.uv).all():
        raise ValueError("texture coordinates that are not finite")


def _concatenate(parts: list[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Concatenate the vertices (n, 3) and faces (m, 3) of meshes."""
    meshes = [part.mesh for part in parts]
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32)
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)])
    return vertices, faces.astype(np.int32)


def _face_colours(part: Part) -> np.ndarray:
    """Return the colour (m, 3) at the centre of each face, of the texture, the vertices or the faces."""
    mesh, image = part
    visual = mesh.visual
    if image is not None:
        centre = np.asarray(visual.uv)[mesh.faces].mean(axis=1) % 1.0
        row = ((1 - centre[:, 1]) * image.shape[0]).astype(int).clip(0, image.shape[0] - 1)
        column = (centre[:, 0] * image.shape[1]).astype(int).clip(0, image.shape[1] - 1)
        return np.asarray(image[row, column])
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors[mesh.faces[:, 0], :3], np.uint8)
    return np.asarray(
        visual.face_colors[:, :3] if visual.kind == "face" else np.zeros((len(mesh.faces), 3)), np.uint8
    )


def _image(visual: Any) -> np.ndarray | None:
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or getattr(visual, "uv", None) is None:
        return None
    return np.asarray(image.convert("RGB"))


def _surface_materials(path: Path, parts: list[Part]) -> tuple[tuple[Material, ...], np.ndarray, np.ndarray]:
    """Return materials, their rows and texture coordinates of the colour mesh; grey with a warning if it is unusable.

    The colours of the semantic mesh are ground truth and must not appear in images.
    """
    faces = sum(len(part.mesh.faces) for part in parts)
    try:
        colour_parts = _colour_parts(path, parts)
    except UserError as error:
        log.warning(f"{error}; the building is grey")
        return colour_texture(np.full((faces, 3), GREY, np.uint8))
    meshes = [part.mesh for part in colour_parts]
    materials = tuple(Material((1.0, 1.0, 1.0), part.image) for part in colour_parts)
    rows = np.repeat(np.arange(len(meshes), dtype=np.int32), [len(mesh.faces) for mesh in meshes])
    uv = np.concatenate([np.asarray(mesh.visual.uv, np.float32)[mesh.faces] for mesh in meshes])
    return materials, rows, uv


def _colour_parts(path: Path, semantic_parts: list[Part]) -> list[Part]:
    """Read the colour mesh, whose triangles must be those of the semantic mesh.

    Raises:
        UserError: if the file is missing or malformed, has other triangles, or has parts without a texture.
    """
    if not path.is_file():
        raise UserError(f"{path}: is missing (it is in the archive hm3d-…-glb)")
    parts = _parts(path)
    colour_corners, semantic_corners = (
        [part.corners() for part in group] for group in (parts, semantic_parts)
    )
    if [len(corners) for corners in colour_corners] != [len(corners) for corners in semantic_corners] or any(
        np.abs(first - second).max() > TOLERANCE
        for first, second in zip(colour_corners, semantic_corners, strict=True)
    ):
        raise UserError(f"{path}: its triangles are not those of the semantic mesh in the same folder")
    if any(part.image is None for part in parts):
        raise UserError(f"{path}: has parts without a texture")
    return parts
