"""The observer: renders views of scenes and builds their ground truth, cached."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from imagination.geometry.camera import Camera
from imagination.geometry.crop import crop
from imagination.geometry.grid import EgoGrid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, project_depth
from imagination.ground_truth.scene_maps import GroundTruth, GroundTruthSpec, build
from imagination.scenes.categories import CategoryTable
from imagination.scenes.renderer import SceneRenderer, renderer_of
from imagination.scenes.scene import Scene
from imagination.scenes.sensor import Sensor
from imagination.scenes.source import SceneSource
from imagination.utils.cache import Cache, as_plain
from imagination.views.view import View


@dataclass(frozen=True)
class Observer:
    """Everything that decides what a view looks like. Picklable: worker processes get a copy.

    Attributes:
        source: where scenes come from.
        camera, sensor: what the robot looks through.
        ego: grid of egocentric maps.
        obstacles: heights above the floor that count as occupied.
        ground_truth_spec: how ground-truth maps are made.
        categories: the category table.
        cache: where ground truth and views are kept.
    """

    source: SceneSource
    camera: Camera
    sensor: Sensor
    ego: EgoGrid
    obstacles: Band
    ground_truth_spec: GroundTruthSpec
    categories: CategoryTable
    cache: Cache
    _loaded: dict[str, tuple[Scene, SceneRenderer]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _truths: dict[str, GroundTruth] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return {
            **self.__dict__,
            "_loaded": {},
            "_truths": {},
        }  # renderers stay in the process that built them

    def scene(self, name: str) -> Scene:
        """The scene, loaded once in each process."""
        return self._load(name)[0]

    def truth(self, name: str) -> GroundTruth:
        """Ground-truth maps of the scene, from the cache where they are kept."""
        if name not in self._truths:
            arrays = self.cache.get_or_build(
                "ground_truth", self.ground_truth_key(name), lambda: self._build_truth(name)
            )
            self._truths[name] = GroundTruth.from_arrays(arrays)
        return self._truths[name]

    def observe(self, name: str, pose: Pose, rng: np.random.Generator) -> View:
        """Look around from `pose` in the scene; `rng` drives the sensor's noise alone.

        Raises:
            UserError: if the scene does not exist or the pose is not finite.
        """
        scene, renderer = self._load(name)
        image = self.sensor(renderer.render(self.camera, self.camera.to_world(pose, scene.floor_height)), rng)
        truth = self.truth(name)
        ego = project_depth(image.depth, self.camera, self.ego, self.obstacles)
        lookup = scene.category_of_instance(self.categories.names)
        categories = np.where(image.instance < 0, np.uint8(0), lookup[np.maximum(image.instance, 0)])
        target = crop(truth.truth, truth.grid, pose, self.ego)
        return View(pose, image.rgb, image.depth, categories, ego.occupied, ego.seen, target)

    def forget(self, name: str) -> None:
        """Drop what is held of a scene that will not be looked at again."""
        self._loaded.pop(name, None)
        self._truths.pop(name, None)

    def ground_truth_key(self, name: str) -> dict[str, Any]:
        """What the scene's ground truth depends on."""
        aliases = {row.name: as_plain(row.aliases) for row in self.categories}
        return {
            "scene": self.source.fingerprint(name),
            "spec": as_plain(self.ground_truth_spec),
            "categories": aliases,
        }

    def view_key(self, name: str) -> dict[str, Any]:
        """What views of the scene depend on, apart from pose and random numbers."""
        parts = {"camera": self.camera, "sensor": self.sensor, "ego": self.ego, "obstacles": self.obstacles}
        return {**self.ground_truth_key(name), **{part: as_plain(value) for part, value in parts.items()}}

    def _load(self, name: str) -> tuple[Scene, SceneRenderer]:
        if name not in self._loaded:
            scene = self.source.load(name)
            self._loaded[name] = scene, renderer_of(scene)
        return self._loaded[name]

    def _build_truth(self, name: str) -> dict[str, np.ndarray]:
        scene, renderer = self._load(name)
        return build(scene, renderer, self.ground_truth_spec, self.categories).to_arrays()
