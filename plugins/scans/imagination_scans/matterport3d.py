"""Matterport3D in its own release and in Habitat's: a `.house` file beside a mesh with instances in its faces."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imagination.scenes.source import Split
from imagination.utils.errors import UserError
from imagination_scans.building import Building, ScannedObject, check_building, coloured
from imagination_scans.layouts import (
    check_id,
    face_colours,
    first_of,
    ply_columns,
    ply_mesh,
    read_ply,
    split_lists,
)

VERSIONS = ("1.0", "1.1")
COUNTS = {"E": 7, "O": 8, "C": 9, "R": 10, "L": 12}
"""Records that the header counts, and where in it."""
LENGTHS = {"H": 24, "L": 7, "R": 16, "C": 6, "O": 16, "E": 14}
"""Least number of words of each record."""
SEGMENT = ("material_id", "face_material")
"""What a face's column with the id of its segment is called."""
OBJECT = ("face_segment", "segment_id", "objectid", "object_id")
"""What a face's column with the index of its object is called."""
SPLIT_LISTS = Path(__file__).parent / "splits"


@dataclass
class House:
    """Records of a `.house` file that are used here.

    Attributes:
        categories: mpcat40 names.
        objects: category and box of each.
        segments: the object of each segment's id, -1 for none.
    """

    categories: dict[int, str] = field(default_factory=dict)
    objects: dict[int, tuple[int, np.ndarray]] = field(default_factory=dict)
    segments: dict[int, int] = field(default_factory=dict)


class Matterport3D:
    """`<id>/house_segmentations/<id>.house` and `<id>.ply`, or Habitat's `<id>/<id>.house` and `<id>_semantic.ply`."""

    name = "matterport3d"
    expected = (
        "<id>/house_segmentations/<id>.house and <id>.ply as in the release (v1/scans), or <id>/<id>.house and "
        "<id>_semantic.ply as for Habitat"
    )

    def buildings(self, folder: Path) -> dict[str, Path]:
        found = {path.stem: path for path in sorted(folder.rglob("*.house"))}
        if not found:
            raise UserError(
                f"matterport3d: found no .house file in {folder.resolve()}; expected {self.expected}"
            )
        return found

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        """The lists scenes_train.txt, scenes_val.txt and scenes_test.txt of the folder, else the official ones."""
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
        materials, face_material, face_uv = coloured(face_colours(rgb, faces))
        # objects count from 0 here, 0 is no object in a building
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
        return first_of(building.parent, f"{building.stem}.ply", f"{building.stem}_semantic.ply")


def _objects_of_faces(ply: Any, path: Path, house: House) -> np.ndarray:
    """The index of each polygon's object: (m,), -1 for none.

    As the authors' viewer has it (niessner/Matterport, mpview/mp.cpp), a face's material is its segment, whose record E
    names the object. Habitat's export, and files without such records, name the object itself.
    """
    if house.segments and set(SEGMENT) & set(ply["face"].data.dtype.names):
        (segment,) = ply_columns(ply, path, "face", SEGMENT, kinds="iu")
        ids, rows = np.unique(segment, return_inverse=True)
        return np.array([house.segments.get(id, -1) for id in ids.tolist()], np.int64)[rows]
    (instance,) = ply_columns(ply, path, "face", OBJECT, kinds="iu")
    return np.asarray(instance, np.int64)


def read_house(path: Path) -> House:
    """Read a `.house` file (format: niessner/Matterport, data_organization.md).

    Raises:
        UserError: with the line and what was expected there.
    """
    try:
        lines = path.read_text().splitlines()
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is no text, expected a .house file") from error
    if not lines or lines[0].split() not in [["ASCII", version] for version in VERSIONS]:
        got = lines[0][:40] if lines else ""
        raise UserError(f"{path}, line 1: got {got!r}, expected ASCII {' or '.join(VERSIONS)}")
    house, expected, counted = House(), {}, dict.fromkeys(COUNTS, 0)
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        if not words or words[0] not in LENGTHS:
            continue
        if len(words) < LENGTHS[words[0]]:
            raise UserError(
                f"{path}, line {number}: got {len(words)} words, expected {LENGTHS[words[0]]} "
                f"or more in a record {words[0]}"
            )
        try:
            if words[0] == "H":
                expected = {record: int(words[place]) for record, place in COUNTS.items()}
            else:
                counted[words[0]] += 1
                _take(house, words)
        except ValueError as error:
            raise UserError(
                f"{path}, line {number}: got {line[:60]!r}, expected numbers, each id once ({error})"
            ) from error
    if not expected:
        raise UserError(f"{path}: has no header, expected a line that begins with H")
    for record, count in expected.items():
        if counted[record] != count:
            raise UserError(
                f"{path}: its header announces {count} records {record}, but it has {counted[record]}; it is truncated "
                "or damaged"
            )
    return house


def _take(house: House, words: list[str]) -> None:
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
    """Corners (8, 3) of a box given by its centre, two of its axes and its half sides."""
    axes = np.stack([first, second, np.cross(first, second)])
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.asarray(centre + (signs * radii) @ axes)
