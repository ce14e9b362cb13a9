"""Scene source of Habitat: scenes of a scene data set, rendered by habitat-sim."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from imagination.geometry.camera import Camera
from imagination.scenes.categories import CategoryTable
from imagination.scenes.scene import FreeSpace, Lighting, Mesh, Scene, SceneObject
from imagination.scenes.source import SPLITS, Split
from imagination.utils.errors import UserError, check_choice, first_of
from imagination.views.pose_samplers import sample_poses
from imagination_habitat.frames import free_grid, upright_box
from imagination_habitat.simulator import CELL_HEIGHT, SIMULATORS, HabitatRenderer, make_navmesh

STOREY = 1.5
"""Minimum height between two floors, metres."""
CEILING = 2.6
"""Height of the ceiling above the floor, metres; the simulator has no value for it."""
SAMPLES = 400
"""Number of navigable points drawn to find the floors."""
VIEWS = 16
"""Number of views without semantics after which a scene is refused."""
UNNAMED = ("", "unknown", "Unknown", "void", "unlabeled")


class HabitatScenes:
    """Scenes of one Habitat data set; only the floor with the largest navmesh is used.

    Args:
        dataset: scene data set config (`.scene_dataset_config.json`); empty if scenes are files.
        scenes: names of the scenes of each split in the data set, or paths.
        names: labels of the data set for each category of the table.
        categories: category table.
        robot_radius: radius of the robot, metres.
        camera: camera of the views in which semantics are checked.
        device: CUDA device; -1 renders in software, which is required on machines without CUDA.
        resolution: cell size of the free-space grid, metres.

    Raises:
        UserError: if a file does not exist, a split is unknown, or a scene is listed more than once.
    """

    name = "habitat"

    def __init__(
        self,
        dataset: str,
        scenes: Mapping[str, Sequence[str]],
        names: Mapping[str, Sequence[str]],
        categories: CategoryTable,
        robot_radius: float,
        camera: Camera,
        device: int,
        resolution: float,
    ) -> None:
        for split in scenes:
            check_choice("data.scenes.scenes", split, SPLITS)
        counts = Counter(name for split_scenes in scenes.values() for name in split_scenes)
        if repeated := [name for name, count in counts.items() if count > 1]:
            raise UserError(
                f"data.scenes.scenes: got {first_of(repeated)} more than once, expected each scene in one split; leave "
                "out the others"
            )
        if dataset and not Path(dataset).is_file():
            raise UserError(
                f"data.scenes.dataset: got {dataset}, which does not exist, expected a *.scene_dataset_config.json"
            )
        self._dataset, self._device = dataset, device
        self._scenes = {split: list(scenes.get(split, ())) for split in SPLITS}
        self._robot_radius, self._camera, self._resolution = robot_radius, camera, resolution
        self._category_of: dict[str, str] = {}
        for category, labels in names.items():
            categories.index(category)
            self._category_of |= dict.fromkeys(labels, category)

    def scenes(self, split: Split) -> list[str]:
        """Return the names of the scenes of a split."""
        check_choice("split", split, SPLITS)
        if not self._scenes[split]:
            raise UserError(f"data.scenes.scenes.{split}: got no scenes, expected at least one")
        return self._scenes[split]

    def load(self, scene: str) -> Scene:
        """Load a scene into the simulator.

        Raises:
            UserError: if the scene does not exist, has no navigable floor, or has empty semantics.
        """
        check_choice("scene", scene, [name for names in self._scenes.values() for name in names])
        simulator = SIMULATORS.show(self._dataset, scene, self._camera, self._device)
        make_navmesh(simulator, self._robot_radius, scene)
        level = navmesh_height(simulator.pathfinder)
        floor = level - CELL_HEIGHT  # the navmesh is one cell above the floor
        free = self._free_space(simulator.pathfinder, level, scene)
        objects, rows = self._objects(simulator, floor)
        if not objects:
            raise UserError(
                f"habitat: scene {scene}: found no named object on the floor at {floor:.2f} m; set "
                "data.scenes.dataset to the scene data set config that lists its semantic files"
            )
        renderer = HabitatRenderer(self._dataset, scene, self._device, rows)
        loaded = Scene(scene, _empty_mesh(), Lighting(), objects, free, floor, floor + CEILING, renderer)
        self._check_semantics(loaded, renderer)
        return loaded

    def identity(self, scene: str) -> str:
        """Return the names of the data set and the scene, or a hash of the content of a scene that is a file."""
        if Path(scene).is_file():
            return f"{self.name} {_content_hash(scene)}"
        return " ".join(filter(None, [self.name, Path(self._dataset).name, scene]))

    def fingerprint(self, scene: str) -> str:
        """Return a hash of the scene's name and file and of the settings, but not of files referred to."""
        files = [
            (path, Path(path).stat().st_mtime_ns) for path in (self._dataset, scene) if Path(path).is_file()
        ]
        settings = self._robot_radius, self._resolution, sorted(self._category_of.items()), str(self._camera)
        text = json.dumps([self.name, self._dataset, scene, files, repr(settings)])
        return hashlib.sha256(text.encode()).hexdigest()

    def _free_space(self, pathfinder: Any, level: float, scene: str) -> FreeSpace:
        view = np.asarray(pathfinder.get_topdown_view(self._resolution, level), bool)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(view.astype(np.uint8), connectivity=4)
        if len(stats) == 1:
            raise UserError(f"habitat: scene {scene}: found no navigable floor at {level:.2f} m")
        largest = labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        return FreeSpace(*free_grid(largest, pathfinder.get_bounds()[0], self._resolution))

    def _objects(self, simulator: Any, floor: float) -> tuple[tuple[SceneObject, ...], dict[int, int]]:
        """Return the named objects between floor and ceiling, and the instance id of each semantic id."""
        objects: list[SceneObject] = []
        rows: dict[int, int] = {}
        for obj in simulator.semantic_scene.objects:
            if obj is None or obj.category is None or (name := obj.category.name()) in UNNAMED:
                continue
            # obj.aabb is not used: it wrongly includes the origin of the world
            box = upright_box(obj.obb.center, obj.obb.half_extents, _quaternion(obj.obb.rotation))
            if not floor - 0.5 <= box.centre[2] <= floor + CEILING + 0.5 or int(obj.semantic_id) == 0:
                continue
            rows[int(obj.semantic_id)] = len(objects) + 1
            category = self._category_of.get(name)
            objects.append(SceneObject(len(objects) + 1, name, category, box, str(obj.id)))
        return tuple(objects), rows

    def _check_semantics(self, scene: Scene, renderer: HabitatRenderer) -> None:
        """Check that the semantic sensor sees an object in at least one view."""
        rng = np.random.default_rng(0)
        for pose in sample_poses(scene.free_space, VIEWS, rng):
            image = renderer.render(self._camera, self._camera.to_world(pose, scene.floor_height))
            if (image.instance > 0).any():
                return
        raise UserError(
            f"habitat: scene {scene.name}: the semantic sensor saw none of {len(scene.objects)} objects in {VIEWS} "
            "views; its semantic mesh is missing or did not load"
        )


def navmesh_height(pathfinder: Any) -> float:
    """Return the height of the floor with most navigable points, metres.

    Raises:
        UserError: if the navmesh is not loaded; a query would abort the process.
    """
    if not pathfinder.is_loaded:
        raise UserError("habitat: the scene has no navmesh")
    pathfinder.seed(0)
    heights = np.sort([pathfinder.get_random_navigable_point()[1] for _ in range(SAMPLES)])
    groups = np.split(heights, np.flatnonzero(np.diff(heights) > STOREY / 2) + 1)
    return float(np.median(max(groups, key=len)))


def _quaternion(rotation: Any) -> tuple[float, float, float, float]:
    """Return the rotation of a box of Habitat, an array x, y, z, w."""
    x, y, z, w = (float(value) for value in np.asarray(rotation).ravel())
    return x, y, z, w


def _empty_mesh() -> Mesh:
    """Return a mesh without triangles; the simulator renders its own."""
    return Mesh(
        np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.int32),
        np.zeros(0, np.int32),
        np.zeros(0, np.int32),
        np.zeros((0, 3, 2), np.float32),
        (),
    )


@cache
def _content_hash(path: str) -> str:
    """Return the hash of the content of a file, which stays the same when the file is moved."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]
