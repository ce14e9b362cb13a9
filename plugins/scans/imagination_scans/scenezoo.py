"""ScanNet, as the library scenezoo reads it; its other data sets have the same interface."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imagination.scenes.source import SPLITS, Split
from imagination.utils.errors import UserError
from imagination_scans.building import GREY, Building, ScannedObject, check_building, coloured
from imagination_scans.layouts import face_colours, split_lists

ENDINGS = (".ply", ".json", ".txt", ".obj", ".glb")


@dataclass(frozen=True)
class SceneZoo:
    """A data set of scenezoo in a folder, one building a sample.

    Attributes:
        dataset: its name there, e.g. "scannetv2".
        lists: file names of lists of samples in the folder, with {split}; without such files scenezoo fetches its own.
        options: further arguments of scenezoo's data set.
    """

    dataset: str
    lists: str
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)

    expected = "the layout of the release (scenezoo's documentation shows it for each data set)"

    @property
    def name(self) -> str:
        return self.dataset

    def buildings(self, folder: Path) -> dict[str, Path]:
        if not any(path.is_dir() for path in folder.iterdir()):  # before its lists are fetched
            raise UserError(
                f"{self.dataset}: found no folder in {folder.resolve()}; expected {self.expected}"
            )
        known = self._splits(folder)
        folders = {path.name: path for path in sorted(folder.glob("**/")) if path.name in known}
        if not folders:
            raise UserError(
                f"{self.dataset}: found no folder in {folder.resolve()} that is called like one of its {len(known)} "
                f"samples; expected {self.expected}"
            )
        return folders

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        return self._splits(folder)

    def files(self, building: Path) -> list[Path]:
        return [path for path in sorted(building.iterdir()) if path.suffix in ENDINGS]

    def read(self, building: Path) -> Building:
        data = self._open(self._root(building))
        try:
            mesh = data.get_mesh(building.name)
            labels = data.get_segmentation(building.name)
        except (
            Exception
        ) as error:  # its errors have no common base: KeyError, OSError, DataFormatError and others
            raise UserError(
                f"{building}: scenezoo cannot read it: {type(error).__name__}: {error}"
            ) from error
        vertices = np.asarray(mesh.vertices, np.float32)
        faces = np.asarray(mesh.triangles, np.int32)
        if labels.is_multilabel or labels.domain == "point":
            raise UserError(
                f"{building}: its labels are of {labels.domain}s, expected one for each vertex or face"
            )
        if labels.domain != "face" and len(labels.labels) != len(vertices):
            raise UserError(f"{building}: got {len(labels.labels)} labels for {len(vertices)} vertices")
        of_face = labels.labels if labels.domain == "face" else labels.labels[faces].max(axis=1)
        if len(of_face) != len(faces):
            raise UserError(f"{building}: got {len(of_face)} labels for {len(faces)} faces")
        rgb = np.full((len(vertices), 3), GREY, np.uint8)
        if mesh.has_vertex_colors():
            rgb = np.round(np.asarray(mesh.vertex_colors) * 255).astype(np.uint8)
        materials, face_material, face_uv = coloured(face_colours(rgb, faces))
        # ids may count from 0, which is no object in a building
        objects = tuple(
            ScannedObject(id + 1, name) for id, name in sorted(labels.id_to_name.items()) if id >= 0
        )
        known = np.isin(of_face, [obj.id - 1 for obj in objects])
        face_object = np.where(known, of_face + 1, 0).astype(np.int32)
        result = Building(vertices, faces, face_object, face_material, face_uv, materials, objects)
        check_building(result, str(building))
        return result

    def _splits(self, folder: Path) -> dict[str, Split]:
        if given := split_lists(folder, self.lists):
            return given
        data = self._open(folder)
        try:
            return {name: split for split in SPLITS if split in data.splits for name in data.get_ids(split)}
        except Exception as error:  # as above; offline, the lists cannot be fetched
            raise UserError(
                f"{self.dataset}: its lists of samples cannot be had ({type(error).__name__}: {error}); put files "
                f"{self.lists} into {folder}, one name a line"
            ) from error

    def _root(self, building: Path) -> Path:
        """The data set's folder: above the sample's, where its lists or its folder of scans lie."""
        for parent in building.parents:
            if split_lists(parent, self.lists) or (parent / "scans").is_dir():
                return parent
        return building.parent

    def _open(self, folder: Path) -> Any:
        try:
            from scenezoo import get_dataset
        except ImportError as error:
            raise UserError(
                f"{self.dataset} is read by scenezoo: pip install 'imagination[scenezoo]'"
            ) from error
        return get_dataset(self.dataset, folder, **self.options)
