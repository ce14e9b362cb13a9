"""Replica for Habitat: `habitat/mesh_semantic.ply` with object ids in its faces, and `info_semantic.json`."""

from collections.abc import Mapping, Sequence
from operator import index
from pathlib import Path

import numpy as np

from imagination.scenes.source import Split
from imagination.utils.errors import UserError
from imagination_scans.building import Building, ScannedObject, check_building, colour_texture
from imagination_scans.layouts import (
    check_id,
    face_colours,
    first_existing,
    hash_fraction,
    ply_columns,
    ply_mesh,
    read_json,
    read_ply,
    split_lists,
)

INFO = "info_semantic.json"


class Replica:
    """Layout of `<scene>/habitat/info_semantic.json` and `mesh_semantic.ply`."""

    name = "replica"
    expected = f"<scene>/habitat/{INFO} and mesh_semantic.ply of the release"

    def buildings(self, folder: Path) -> dict[str, Path]:
        buildings = {path.parent.parent.name: path for path in sorted(folder.rglob(f"habitat/{INFO}"))}
        if not buildings:
            raise UserError(
                f"replica: found no habitat/{INFO} in {folder.resolve()}; expected {self.expected}"
            )
        return buildings

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        """Return the splits by lists replica_train.txt, … in the folder, else by a hash of each name.

        The data set has no official splits. The hash assigns about a quarter each to test and validation. The FRL
        apartments are one apartment with different furniture and stay in one split.
        """
        lists = split_lists(folder, "replica_{split}.txt")
        quarters: tuple[Split, ...] = ("test", "val", "train", "train")
        groups = {name: "frl_apartment" if name.startswith("frl_apartment") else name for name in names}
        return lists or {name: quarters[int(4 * hash_fraction(group))] for name, group in groups.items()}

    def files(self, building: Path) -> list[Path]:
        return [building, first_existing(building.parent, "mesh_semantic.ply")]

    def read(self, building: Path) -> Building:
        objects, path = read_objects(building), self.files(building)[1]
        ply = read_ply(path)
        vertices, faces, owner, rgb = ply_mesh(ply, path)
        (instance,) = ply_columns(ply, path, "face", ["object_id", "objectid"], kinds="iu")
        materials, face_material, face_uv = colour_texture(face_colours(rgb, faces))
        face_object = np.asarray(instance, np.int64)[owner] + 1
        known = np.isin(face_object, [obj.id for obj in objects])
        face_object = np.where(known, face_object, 0).astype(np.int32)
        result = Building(vertices, faces, face_object, face_material, face_uv, materials, objects)
        check_building(result, str(building))
        return result


def read_objects(path: Path) -> tuple[ScannedObject, ...]:
    """Read the objects of an info_semantic.json.

    Raises:
        UserError: if the file is malformed; the message names the object.
    """
    info = read_json(path)
    if not isinstance(info, dict) or not isinstance(info.get("objects"), list):
        raise UserError(f"{path}: has no list 'objects', expected {INFO} of Replica")
    objects: dict[int, ScannedObject] = {}
    for number, entry in enumerate(info["objects"]):
        try:
            corners = _corners(entry["oriented_bbox"]) if "oriented_bbox" in entry else None
            id = check_id(index(entry["id"]), objects)
            objects[id] = ScannedObject(id + 1, str(entry["class_name"]), corners)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise UserError(
                f"{path}: objects[{number}] is invalid ({error!r}), expected id, class_name and oriented_bbox"
            ) from error
    return tuple(objects.values())


def _corners(box: Mapping[str, Mapping[str, Sequence[float]]]) -> np.ndarray:
    """Return the corners (8, 3) of a box in a frame with a rotation (quaternion x, y, z, w) and a translation."""
    x, y, z, w = np.array(box["orientation"]["rotation"], float) / np.linalg.norm(
        box["orientation"]["rotation"]
    )
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    centre, half = np.array(box["abb"]["center"], float), np.array(box["abb"]["sizes"], float) / 2
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    corners = (centre + signs * half) @ rotation.T + np.array(box["orientation"]["translation"], float)
    if corners.shape != (8, 3) or not np.isfinite(corners).all():
        raise ValueError("a box that is not finite")
    return np.asarray(corners)
