"""Scene source of scanned buildings: each floor of each building is a scene."""

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from imagination.ground_truth.scene_maps import needed_extent
from imagination.scenes.categories import CategoryTable
from imagination.scenes.free_space import free_space
from imagination.scenes.scene import Lighting, Scene, SceneObject
from imagination.scenes.source import SPLITS, Credit, Split
from imagination.utils.cache import Cache
from imagination.utils.cache_key import as_plain
from imagination.utils.code_hash import module_hash
from imagination.utils.errors import UserError, check_choice
from imagination_scans.building import (
    Building,
    Floor,
    ScannedObject,
    crop_to_floor,
    floors_of,
    mesh_of,
    upright_box,
)
from imagination_scans.layouts import Layout

log = logging.getLogger(__name__)

BRIGHT = Lighting((1.0, 1.0, 1.0))
"""Uniform lighting; the colours of scans include shading."""


class ScannedBuildings:
    """Floors of the buildings of one data set.

    Args:
        layout: layout of the data set on disk.
        folder: folder of the data set.
        names: labels of the data set for each category of the table.
        categories: category table.
        robot_radius: radius of the robot, metres.
        clearance: heights above the floor in which the robot can collide, metres; scanned floors are uneven.
        largest: side of the global map, metres; floors that do not fit in it are skipped with a message.
        cache: cache of the floors of buildings.
        licence: licence of the data set.

    Raises:
        UserError: if the folder does not exist or has another layout.
    """

    def __init__(
        self,
        layout: Layout,
        folder: str | None,
        names: Mapping[str, Sequence[str]],
        categories: CategoryTable,
        robot_radius: float,
        clearance: Sequence[float],
        largest: float,
        cache: Cache,
        licence: str,
    ) -> None:
        self.name = layout.name
        if not folder:
            raise UserError(f"data.scenes.folder: got null, expected a folder with {layout.expected}")
        self._layout, self._folder, self._cache = layout, Path(folder), cache
        self._robot_radius, self._clearance, self._largest = robot_radius, tuple(clearance), largest
        self._licence = licence
        self._category_of: dict[str, str] = {}
        for category, labels in names.items():
            categories.index(category)
            self._category_of |= dict.fromkeys(labels, category)
        if not self._folder.is_dir():
            raise UserError(
                f"data.scenes.folder: got {self._folder.resolve()}, which does not exist, expected a folder with "
                f"{layout.expected}"
            )
        self._buildings = layout.buildings(self._folder)
        self._split_of = layout.splits(self._folder, list(self._buildings))

    def scenes(self, split: Split) -> list[str]:
        """Return the usable floors of the buildings of a split; others are logged.

        Each building is read once; later calls read the cache.
        """
        check_choice("split", split, SPLITS)
        selected = [name for name in self._buildings if self._split_of.get(name) == split]
        names = [f"{name}_{floor}" for name in selected for floor in self._usable(name)]
        if not names:
            unassigned = sum(name not in self._split_of for name in self._buildings)
            raise UserError(
                f"split {split}: none of {len(self._buildings)} buildings in {self._folder} gives a scene "
                f"({len(selected)} are in this split, {unassigned} in no split); add lists of names for the splits, or "
                "more data"
            )
        return names

    def load(self, scene: str) -> Scene:
        """Load one floor.

        Raises:
            UserError: if the floor does not exist, its files are malformed, or it has no free space.
        """
        name, number = self._parse(scene)
        floor, _ = self._floors(name)[number]
        return self._scene(scene, _building(self._layout, self._buildings[name]), floor)

    def identity(self, scene: str) -> str:
        """Return the names of the data set, the building and the floor, whatever the split of the building."""
        return f"{self.name} {scene}"

    def fingerprint(self, scene: str) -> str:
        """Return a hash of the building's files (sizes and times), layout, robot and names."""
        name, number = self._parse(scene)
        settings = self._robot_radius, self._clearance, sorted(self._category_of.items())
        text = repr((self._key(name), number, settings))
        return hashlib.sha256(text.encode()).hexdigest()

    def credits(self) -> Sequence[Credit]:
        """Return a credit to the data set for each building."""
        return [
            Credit(split, "building", name, self.name, self._licence, str(self._folder))
            for name, split in sorted(self._split_of.items())
            if name in self._buildings
        ]

    def _parse(self, scene: str) -> tuple[str, int]:
        name, _, number = scene.rpartition("_")
        if name in self._buildings and number.isdecimal() and int(number) < len(self._floors(name)):
            return name, int(number)
        raise UserError(
            f"scene: got {scene!r}, expected the name of a building and the number of a floor, such as "
            f"{next(iter(self._buildings))}_0; buildings: {', '.join(list(self._buildings)[:20])}"
        )

    def _object(self, instance: int, obj: ScannedObject, part: Building) -> SceneObject:
        corners = part.vertices[np.unique(part.faces[part.face_object == obj.id])]
        box = upright_box(corners, obj.corners)
        return SceneObject(instance, obj.name, self._category_of.get(obj.name), box, f"{self.name}/{obj.id}")

    def _scene(self, scene: str, building: Building, floor: Floor) -> Scene:
        """Convert a floor to a scene.

        Raises:
            UserError: if the floor has no objects or no free space.
        """
        part, annotated = crop_to_floor(building, floor)
        if not annotated:
            raise UserError(f"scene {scene}: no annotated object is on this floor; its semantics are empty")
        mesh = mesh_of(part)
        objects = tuple(self._object(number, obj, part) for number, obj in enumerate(annotated, start=1))
        low, high = self._clearance
        try:
            free = free_space(mesh, floor.height, self._robot_radius, clearance=(low, high))
        except UserError as error:
            raise UserError(f"scene {scene} of {self._folder}: {error}") from error
        return Scene(scene, mesh, BRIGHT, objects, free, floor.height, floor.ceiling)

    def _usable(self, name: str) -> list[int]:
        """Return the numbers of the usable floors; log the others."""
        usable = []
        for number, (_, problem) in enumerate(self._floors(name)):
            if problem:
                log.warning(f"{self.name}: skipped: {problem}")
            else:
                usable.append(number)
        return usable

    def _floors(self, name: str) -> list[tuple[Floor, str]]:
        """Return the floors of a building with the problem of each (empty if usable), from the cache if possible."""

        def find_floors() -> dict[str, np.ndarray]:
            building = _building(self._layout, self._buildings[name])
            try:
                floors = floors_of(building)
            except UserError as error:
                raise UserError(f"{self._buildings[name]}: {error}") from error
            problems = [self._problem(f"{name}_{number}", building, f) for number, f in enumerate(floors)]
            return {
                "floors": np.array([(f.height, f.ceiling) for f in floors]),
                "problems": np.frombuffer(json.dumps(problems).encode(), np.uint8),
            }

        settings = [self._robot_radius, *self._clearance, self._largest]
        key = {"building": self._key(name), "floors": settings, "code": module_hash(__name__)}
        arrays = self._cache.get_or_build("buildings", key, find_floors)
        problems: list[str] = json.loads(arrays["problems"].tobytes())
        return [
            (Floor(*row), problem) for row, problem in zip(arrays["floors"].tolist(), problems, strict=True)
        ]

    def _problem(self, scene: str, building: Building, floor: Floor) -> str:
        """Return why a floor cannot be a scene; empty if it can."""
        try:
            needed = needed_extent(self._scene(scene, building, floor))
        except UserError as error:
            return str(error)
        if needed >= self._largest:
            return f"scene {scene}: needs a map of {needed:.1f} m, the global map has {self._largest} m"
        return ""

    def _key(self, name: str) -> str:
        files = self._layout.files(self._buildings[name])
        stamps = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
        return json.dumps([self.name, name, stamps, as_plain(self._layout)])


@lru_cache(maxsize=2)
def _building(layout: Layout, path: Path) -> Building:
    """Read a building; the last one is cached, since its floors are usually loaded one after another."""
    return layout.read(path)
