"""Data sets read by the library scenezoo, such as ScanNet."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imagination.scenes.source import SPLITS, Split
from imagination.utils.errors import UserError, require_extra
from imagination_scans.building import GREY, Building, ScannedObject, check_building, colour_texture
from imagination_scans.layouts import face_colours, split_lists

SUFFIXES = (".ply", ".json", ".txt", ".obj", ".glb")


@dataclass(frozen=True)
class SceneZoo:
    """Layout of a data set of scenezoo, one building per sample.

    Attributes:
        dataset: name of the data set in scenezoo, e.g. "scannetv2".
        lists: pattern with {split} of the files of sample names in the folder; scenezoo downloads missing lists.
        options: further arguments of the data set in scenezoo.
    """

    dataset: str
    lists: str
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)

    expected = "the layout of the release (see the documentation of scenezoo)"

    @property
    def name(self) -> str:
        return self.dataset

    def buildings(self, folder: Path) -> dict[str, Path]:
        if not any(path.is_dir() for path in folder.iterdir()):  # checked before lists are downloaded
            raise UserError(
                f"{self.dataset}: found no folder in {folder.resolve()}; expected {self.expected}"
            )
        samples = self._splits(folder)
        folders = {path.name: path for path in sorted(folder.glob("**/")) if path.name in samples}
        if not folders:
            raise UserError(
                f"{self.dataset}: found no folder in {folder.resolve()} with the name of one of {len(samples)} "
                f"samples; expected {self.expected}"
            )
        return folders

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        return self._splits(folder)

    def files(self, building: Path) -> list[Path]:
        return [path for path in sorted(building.iterdir()) if path.suffix in SUFFIXES]

    def read(self, building: Path) -> Building:
        data = self._open(self._root(building))
        try:
            mesh = data.get_mesh(building.name)
            labels = data.get_segmentation(building.name)
        except Exception as error:  # KeyError, OSError, DataFormatError and others without a common base
            raise UserError(
                f"{building}: scenezoo cannot read it: {type(error).__name__}: {error}"
            ) from error
        vertices = np.asarray(mesh.vertices, np.float32)
        faces = np.asarray(mesh.triangles, np.int32)
        if labels.is_multilabel or labels.domain == "point":
            raise UserError(
                f"{building}: got labels of {labels.domain}s, expected one label for each vertex or face"
            )
        if labels.domain != "face" and len(labels.labels) != len(vertices):
            raise UserError(f"{building}: got {len(labels.labels)} labels for {len(vertices)} vertices")
        face_labels = labels.labels if labels.domain == "face" else labels.labels[faces].max(axis=1)
        if len(face_labels) != len(faces):
            raise UserError(f"{building}: got {len(face_labels)} labels for {len(faces)} faces")
        rgb = np.full((len(vertices), 3), GREY, np.uint8)
        if mesh.has_vertex_colors():
            rgb = np.round(np.asarray(mesh.vertex_colors) * 255).astype(np.uint8)
        materials, face_material, face_uv = colour_texture(face_colours(rgb, faces))
        # ids may begin at 0, which is no object in a Building
        objects = tuple(
            ScannedObject(id + 1, name) for id, name in sorted(labels.id_to_name.items()) if id >= 0
        )
        known = np.isin(face_labels, [obj.id - 1 for obj in objects])
        face_object = np.where(known, face_labels + 1, 0).astype(np.int32)
        result = Building(vertices, faces, face_object, face_material, face_uv, materials, objects)
        check_building(result, str(building))
        return result

    def _splits(self, folder: Path) -> dict[str, Split]:
        if lists := split_lists(folder, self.lists):
            return lists
        data = self._open(folder)
        try:
            return {name: split for split in SPLITS if split in data.splits for name in data.get_ids(split)}
        except Exception as error:  # as above; without network the lists cannot be downloaded
            raise UserError(
                f"{self.dataset}: cannot get the lists of samples ({type(error).__name__}: {error}); put files "
                f"{self.lists} with one name per line into {folder}"
            ) from error

    def _root(self, building: Path) -> Path:
        """Return the folder of the data set: the parent of a sample that contains the lists or the folder scans."""
        for parent in building.parents:
            if split_lists(parent, self.lists) or (parent / "scans").is_dir():
                return parent
        return building.parent

    def _open(self, folder: Path) -> Any:
        require_extra("scenezoo", "scenezoo")
        from scenezoo import get_dataset

        return get_dataset(self.dataset, folder, **self.options)
