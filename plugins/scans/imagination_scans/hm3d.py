"""HM3D: `<id>.semantic.glb`, whose textures paint each object in a colour of its own, and `<id>.semantic.txt`."""

import csv
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from imagination.scenes.scene import Material
from imagination.scenes.source import Split
from imagination.utils.errors import UserError
from imagination_scans.building import GREY, Building, ScannedObject, check_building, coloured
from imagination_scans.layouts import check_id, lot, split_lists

log = logging.getLogger(__name__)

HEADER = "HM3D Semantic Annotations"
COLOUR = re.compile(r"[0-9A-Fa-f]{6}")
APART = 0.001
"""Triangles whose corners are nearer than this, metres, are the same in two files."""


class HM3D:
    """Folders train and val of `<number>-<id>` with `<id>.semantic.glb`, `.semantic.txt` and, for colour, `.glb`."""

    name = "hm3d"
    expected = (
        "train/<number>-<id>/<id>.semantic.glb, <id>.semantic.txt and, for colours, <id>.glb (the archives "
        "hm3d-…-semantic-annots and hm3d-…-glb)"
    )

    def buildings(self, folder: Path) -> dict[str, Path]:
        found = {path.name.partition(".")[0]: path for path in sorted(folder.rglob("*.semantic.txt"))}
        if not found:
            raise UserError(f"hm3d: found no .semantic.txt in {folder.resolve()}; expected {self.expected}")
        return found

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        """Lists hm3d_train.txt, … of the folder, else the folders train and val (minival is a part of it).

        The official test split has no annotation, so about half of val is for test, by a hash of each name.
        """
        found: dict[str, Split] = {}
        for name, path in self.buildings(folder).items():
            match path.resolve().parent.parent.name:
                case "train":
                    found[name] = "train"
                case "val" | "minival":
                    found[name] = "test" if lot(name) < 0.5 else "val"
        return split_lists(folder, "hm3d_{split}.txt") or found

    def files(self, building: Path) -> list[Path]:
        painted, shown = self._meshes(building)
        if not painted.is_file():
            raise UserError(f"{building.parent}: has {building.name} but no {painted.name}")
        return [path for path in (building, painted, shown) if path.is_file()]

    def read(self, building: Path) -> Building:
        by_colour = read_annotation(building)
        painted_path, shown_path = self._meshes(building)
        parts = _parts(painted_path)
        painted = np.concatenate([_face_colour(part) for part in parts])
        code = (painted.astype(np.int64) * [65536, 256, 1]).sum(axis=1)
        colours, rows = np.unique(code, return_inverse=True)
        ids = np.array([by_colour[c].id if c in by_colour else 0 for c in colours.tolist()], np.int32)
        vertices, faces = _joined(parts)
        materials, face_material, face_uv = _panorama_poses(shown_path, parts)
        objects = tuple(by_colour.values())
        result = Building(vertices, faces, ids[rows], face_material, face_uv, materials, objects)
        check_building(result, str(building))
        return result

    def _meshes(self, building: Path) -> tuple[Path, Path]:
        """Where the painted mesh and the coloured one lie."""
        stem = building.name.partition(".")[0]
        return building.with_name(f"{stem}.semantic.glb"), building.with_name(f"{stem}.glb")


def read_annotation(path: Path) -> dict[int, ScannedObject]:
    """Objects of a `.semantic.txt` by their colour as a number, 0xRRGGBB.

    Raises:
        UserError: with the line and what was expected there.
    """
    try:
        lines = path.read_text().splitlines()
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is no text, expected {HEADER}") from error
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
            taken.add(check_id(int(id), taken, least=1))
        except (ValueError, csv.Error) as error:
            raise UserError(
                f"{path}, line {number}: got {line[:60]!r}, expected an id, a colour of six hexadecimal "
                f'digits, a name in quotes and a region, as in 1,C7D5C5,"chair",0 ({error})'
            ) from error
        if int(colour, 16) in objects:
            raise UserError(
                f"{path}, line {number}: the colour {colour} occurs twice, expected one for each object"
            )
        objects[int(colour, 16)] = ScannedObject(int(id), name.strip())
    return objects


class Part(NamedTuple):
    """One mesh of a GLB file, and its texture if it has one."""

    mesh: Any
    image: np.ndarray | None

    def corners(self) -> np.ndarray:
        """Of its triangles: (m, 3, 3), metres."""
        return np.asarray(self.mesh.vertices[self.mesh.faces], np.float32)


def _parts(path: Path) -> list[Part]:
    """Meshes of a GLB file in world coordinates; z is up, as the data set has it.

    Raises:
        UserError: if the extra is not installed or the file is malformed.
    """
    try:
        import trimesh
    except ImportError as error:
        raise UserError("HM3D needs trimesh: pip install 'imagination[scans]'") from error
    try:
        scene = trimesh.load_scene(path, process=False)
        meshes = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
        parts = [Part(mesh, _image(mesh.visual)) for mesh in meshes]
        for part in parts:
            _check_part(part)
    except Exception as error:  # trimesh raises whatever the parts of the file it stumbled on raise
        raise UserError(f"{path}: cannot be read as GLB: {type(error).__name__}: {error}") from error
    if not parts:
        raise UserError(f"{path}: holds no mesh")
    return parts


def _check_part(part: Part) -> None:
    """Refuse what trimesh passes on.

    Raises:
        ValueError: with what is wrong.
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


def _joined(parts: list[Part]) -> tuple[np.ndarray, np.ndarray]:
    meshes = [part.mesh for part in parts]
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32)
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)])
    return vertices, faces.astype(np.int32)


def _face_colour(part: Part) -> np.ndarray:
    """What colour a part's texture, or its vertices, give each face: (m, 3) uint8, at the middle of the face."""
    mesh, image = part
    visual = mesh.visual
    if image is not None:
        middle = np.asarray(visual.uv)[mesh.faces].mean(axis=1) % 1.0
        row = ((1 - middle[:, 1]) * image.shape[0]).astype(int).clip(0, image.shape[0] - 1)
        column = (middle[:, 0] * image.shape[1]).astype(int).clip(0, image.shape[1] - 1)
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


def _panorama_poses(path: Path, parts: list[Part]) -> tuple[tuple[Material, ...], np.ndarray, np.ndarray]:
    """Materials, rows and texture coordinates of the coloured mesh; grey, with a warning, if it cannot be used.

    What the semantic mesh is painted with is the answer, which no image may show.
    """
    faces = sum(len(part.mesh.faces) for part in parts)
    try:
        shown = _coloured_parts(path, parts)
    except UserError as error:
        log.warning(f"{error}; the building is grey")
        return coloured(np.full((faces, 3), GREY, np.uint8))
    materials = tuple(Material((1.0, 1.0, 1.0), part.image) for part in shown)
    rows = np.repeat(np.arange(len(shown), dtype=np.int32), [len(part.mesh.faces) for part in shown])
    uv = np.concatenate([np.asarray(part.mesh.visual.uv, np.float32)[part.mesh.faces] for part in shown])
    return materials, rows, uv


def _coloured_parts(path: Path, parts: list[Part]) -> list[Part]:
    """The coloured mesh, whose triangles are those of the semantic one.

    Raises:
        UserError: if it is missing, malformed, has other triangles or has parts without a texture.
    """
    if not path.is_file():
        raise UserError(f"{path}: is missing (it is in the archive hm3d-…-glb)")
    shown = _parts(path)
    there, here = ([part.corners() for part in some] for some in (shown, parts))
    if [len(corners) for corners in there] != [len(corners) for corners in here] or any(
        np.abs(one - other).max() > APART for one, other in zip(there, here, strict=True)
    ):
        raise UserError(f"{path}: its triangles are not those of the semantic mesh beside it")
    if any(part.image is None for part in shown):
        raise UserError(f"{path}: has parts without a texture")
    return shown
