"""Matterport3D in the original release and for Habitat: a `.house` file and a mesh with instance ids in its faces."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imagination.scenes.source import Split
from imagination.utils.errors import UserError
from imagination_scans.building import Building, ScannedObject, check_building, colour_texture
from imagination_scans.layouts import (
    check_id,
    face_colours,
    first_existing,
    ply_columns,
    ply_mesh,
    read_ply,
    split_lists,
)

VERSIONS = ("1.0", "1.1")
COUNTS = {"E": 7, "O": 8, "C": 9, "R": 10, "L": 12}
"""Records counted in the header, with the position of the count."""
LENGTHS = {"H": 24, "L": 7, "R": 16, "C": 6, "O": 16, "E": 14}
"""Minimum number of words of each record."""
SEGMENT_COLUMNS = ("material_id", "face_material")
"""Possible names of the face column with the segment id."""
OBJECT_COLUMNS = ("face_segment", "segment_id", "objectid", "object_id")
"""Possible names of the face column with the object index."""
SPLIT_LISTS = Path(__file__).parent / "splits"
"""Folder of the official lists of buildings."""


@dataclass
class House:
    """Records of a `.house` file, by id.

    Attributes:
        categories: names of mpcat40.
        objects: category and corners of the box of each object.
        segments: object of each segment, -1 for segments without an object.
    """

    categories: dict[int, str] = field(default_factory=dict)
    objects: dict[int, tuple[int, np.ndarray]] = field(default_factory=dict)
    segments: dict[int, int] = field(default_factory=dict)


class Matterport3D:
    """Layout of `<id>/house_segmentations/<id>.house` and `<id>.ply`.

    Habitat's layout, `<id>/<id>.house` and `<id>_semantic.ply`, is supported as well.
    """

    name = "matterport3d"
    expected = (
        "<id>/house_segmentations/<id>.house and <id>.ply of the release (v1/scans), or <id>/<id>.house and "
        "<id>_semantic.ply for Habitat"
    )

    def buildings(self, folder: Path) -> dict[str, Path]:
        buildings = {path.stem: path for path in sorted(folder.rglob("*.house"))}
        if not buildings:
            raise UserError(
                f"matterport3d: found no .house file in {folder.resolve()}; expected {self.expected}"
            )
        return buildings

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        """Return the splits by lists scenes_train.txt, … in the folder, else the official splits."""
        return split_lists(folder, "scenes_{split}.txt") or split_lists(
            SPLIT_LISTS, "matterport3d_{split}.txt"
        )

    def files(self, building: Path) -> list[Path]:
        return [building, self._mesh(building)]

    def read(self, building: Path) -> Building:
        house, path = read_house(building), self._mesh(building)
        ply = read_ply(path)
        vertices, faces, owner, rgb = ply_mesh(ply, path)
        instance = _objects_of_faces(ply, path, house)
        materials, face_material, face_uv = colour_texture(face_colours(rgb, faces))
        # ids of the file begin at 0, which is no object in a Building
        objects = tuple(
            ScannedObject(number + 1, house.categories.get(category, "unlabeled"), corners)
            for number, (category, corners) in sorted(house.objects.items())
        )
        face_object = instance[owner] + 1
        known = np.isin(face_object, [obj.id for obj in objects])
        result = Building(
            vertices,
            faces,
            np.where(known, face_object, 0).astype(np.int32),
            face_material,
            face_uv,
            materials,
            objects,
        )
        check_building(result, str(building))
        return result

    def _mesh(self, building: Path) -> Path:
        return first_existing(building.parent, f"{building.stem}.ply", f"{building.stem}_semantic.ply")


def _objects_of_faces(ply: Any, path: Path, house: House) -> np.ndarray:
    """Return the object index of each polygon (m,), -1 for no object.

    As in the authors' viewer (niessner/Matterport, mpview/mp.cpp), the material of a face is its segment, whose record
    E names the object. Files for Habitat, and files without records E, name the object directly.
    """
    if house.segments and set(SEGMENT_COLUMNS) & set(ply["face"].data.dtype.names):
        (segment,) = ply_columns(ply, path, "face", SEGMENT_COLUMNS, kinds="iu")
        ids, rows = np.unique(segment, return_inverse=True)
        return np.array([house.segments.get(id, -1) for id in ids.tolist()], np.int64)[rows]
    (instance,) = ply_columns(ply, path, "face", OBJECT_COLUMNS, kinds="iu")
    return np.asarray(instance, np.int64)


def read_house(path: Path) -> House:
    """Read a `.house` file (format: niessner/Matterport, data_organization.md).

    Raises:
        UserError: if the file is malformed; the message names the line.
    """
    try:
        lines = path.read_text().splitlines()
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is not a text file, expected a .house file") from error
    if not lines or lines[0].split() not in [["ASCII", version] for version in VERSIONS]:
        first = lines[0][:40] if lines else ""
        raise UserError(f"{path}, line 1: got {first!r}, expected ASCII {' or '.join(VERSIONS)}")
    house, announced, counted = House(), {}, dict.fromkeys(COUNTS, 0)
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        if not words or words[0] not in LENGTHS:
            continue
        if len(words) < LENGTHS[words[0]]:
            raise UserError(
                f"{path}, line {number}: got {len(words)} words, expected at least {LENGTHS[words[0]]} in a record "
                f"{words[0]}"
            )
        try:
            if words[0] == "H":
                announced = {record: int(words[position]) for record, position in COUNTS.items()}
            else:
                counted[words[0]] += 1
                _parse_record(house, words)
        except ValueError as error:
            raise UserError(
                f"{path}, line {number}: got {line[:60]!r}, expected numbers and unique ids ({error})"
            ) from error
    if not announced:
        raise UserError(f"{path}: has no header, expected a line that begins with H")
    for record, count in announced.items():
        if counted[record] != count:
            raise UserError(
                f"{path}: its header announces {count} records {record}, but it has {counted[record]}; it is truncated "
                "or damaged"
            )
    return house


def _parse_record(house: House, words: list[str]) -> None:
    match words[0]:
        case "C":
            house.categories[check_id(int(words[1]), house.categories)] = words[5].replace("#", " ")
        case "O":
            numbers = np.array([float(word) for word in words[4:16]])
            if not np.isfinite(numbers).all():
                raise ValueError("a box that is not finite")
            id = check_id(int(words[1]), house.objects)
            house.objects[id] = int(words[3]), box_corners(*numbers.reshape(4, 3))
        case "E":
            house.segments[check_id(int(words[3]), house.segments)] = int(words[2])


def box_corners(centre: np.ndarray, first: np.ndarray, second: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3) of a box with a centre, two axes and half sides."""
    axes = np.stack([first, second, np.cross(first, second)])
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.asarray(centre + (signs * radii) @ axes)
