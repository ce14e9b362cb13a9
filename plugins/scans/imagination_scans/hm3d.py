"""HM3D: `<id>.semantic.glb`, whose textures paint each object in a colour of its own, and `<id>.semantic.txt`."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imagination.errors import UserError
from imagination.scenes.scene import Material, Split
from imagination_scans.building import Building, ScannedObject, check_building, coloured

HEADER = "HM3D Semantic Annotations"


class HM3D:
    """Folders train and val of `<number>-<id>` with `<id>.semantic.glb`, `.semantic.txt` and, for colour, `.glb`."""

    name = "hm3d"

    def buildings(self, folder: Path) -> dict[str, Path]:
        found = {path.name.partition(".")[0]: path for path in sorted(folder.rglob("*.semantic.txt"))}
        if not found:
            raise UserError(
                f"hm3d: found no .semantic.txt in {folder.resolve()}; expected train/<number>-<id>/<id>.semantic.glb, "
                "<id>.semantic.txt and, for colours, <id>.glb (the archives hm3d-…-semantic-annots and hm3d-…-glb)"
            )
        return found

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        """By the folders train and val; the official test split has no annotation, so half of val is for test."""
        found: dict[str, Split] = {}
        held_out = []
        for name, path in self.buildings(folder).items():
            if "train" in path.relative_to(folder).parts:
                found[name] = "train"
            else:
                held_out.append(name)
        for number, name in enumerate(sorted(held_out)):
            found[name] = "val" if number % 2 else "test"
        return found

    def files(self, building: Path) -> list[Path]:
        stem = building.name.partition(".")[0]
        paths = [building, building.with_name(f"{stem}.semantic.glb"), building.with_name(f"{stem}.glb")]
        if not paths[1].is_file():
            raise UserError(f"{building.parent}: has {building.name} but no {paths[1].name}")
        return [path for path in paths if path.is_file()]

    def read(self, building: Path) -> Building:
        by_colour = read_annotation(building)
        files = self.files(building)
        parts = _parts(files[1])
        painted = np.concatenate([_face_colour(part) for part in parts])
        code = (painted.astype(np.int64) * [65536, 256, 1]).sum(axis=1)
        colours, rows = np.unique(code, return_inverse=True)
        ids = np.array([by_colour[c].id if c in by_colour else 0 for c in colours.tolist()], np.int32)
        vertices, faces = _joined(parts)
        looks = _looks(files[2], parts) if len(files) > 2 else None
        materials, face_material, face_uv = looks or coloured(painted)
        objects = tuple(by_colour.values())
        result = Building(vertices, faces, ids[rows], face_material, face_uv, materials, objects)
        check_building(result, str(building))
        return result


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
    for number, row in enumerate(csv.reader(lines[1:]), start=2):
        if not row:
            continue
        try:
            id, colour, name = int(row[0]), int(row[1], 16), row[2].strip()
        except (ValueError, IndexError) as error:
            raise UserError(
                f"{path}, line {number}: got {lines[number - 1][:60]!r}, expected an id, a colour of six hexadecimal "
                'digits, a name in quotes and a region, as in 1,C7D5C5,"chair",0'
            ) from error
        if colour in objects:
            raise UserError(
                f"{path}, line {number}: the colour {row[1]} occurs twice, expected one for each object"
            )
        objects[colour] = ScannedObject(id, name)
    return objects


def _parts(path: Path) -> list[Any]:
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
        parts = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    except Exception as error:  # trimesh raises whatever the parts of the file it stumbled on raise
        raise UserError(f"{path}: cannot be read as GLB: {type(error).__name__}: {error}") from error
    if not parts:
        raise UserError(f"{path}: holds no mesh")
    return parts


def _joined(parts: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts]).astype(np.float32)
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    return vertices, faces.astype(np.int32)


def _face_colour(part: Any) -> np.ndarray:
    """What colour a part's texture, or its vertices, give each face: (m, 3) uint8, at the middle of the face."""
    visual = part.visual
    image = _image(visual)
    if image is not None:
        middle = np.asarray(visual.uv)[part.faces].mean(axis=1) % 1.0
        row = ((1 - middle[:, 1]) * image.shape[0]).astype(int).clip(0, image.shape[0] - 1)
        column = (middle[:, 0] * image.shape[1]).astype(int).clip(0, image.shape[1] - 1)
        return np.asarray(image[row, column])
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors[part.faces[:, 0], :3], np.uint8)
    return np.asarray(
        visual.face_colors[:, :3] if visual.kind == "face" else np.zeros((len(part.faces), 3)), np.uint8
    )


def _image(visual: Any) -> np.ndarray | None:
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or getattr(visual, "uv", None) is None:
        return None
    return np.asarray(image.convert("RGB"))


def _looks(path: Path, parts: list[Any]) -> tuple[tuple[Material, ...], np.ndarray, np.ndarray] | None:
    """Materials, rows and texture coordinates of the coloured mesh, if its faces are those of the semantic one."""
    shown = _parts(path)
    if [len(part.faces) for part in shown] != [len(part.faces) for part in parts]:
        return None
    materials, rows, coordinates = [], [], []
    for number, part in enumerate(shown):
        image = _image(part.visual)
        if image is None:
            return None
        materials.append(Material((1.0, 1.0, 1.0), image))
        rows.append(np.full(len(part.faces), number, np.int32))
        coordinates.append(np.asarray(part.visual.uv, np.float32)[part.faces])
    return tuple(materials), np.concatenate(rows), np.concatenate(coordinates)
