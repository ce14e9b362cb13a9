"""Observer that renders views of scenes and builds their ground truth, with a cache."""

import hashlib
import json
from dataclasses import dataclass, field
from functools import cached_property
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
from imagination.utils.cache import Cache
from imagination.utils.cache_key import as_plain, plugin_code
from imagination.views.view import View


@dataclass(frozen=True)
class Observer:
    """Renderer of views and builder of ground truth; picklable, so that each worker process gets a copy.

    Attributes:
        source: source of the scenes.
        camera, sensor: camera of the robot and its sensor model.
        ego: grid of egocentric maps.
        obstacles: heights above the floor of obstacles (occupied cells).
        ground_truth_spec: specification of the ground-truth maps.
        categories: category table.
        cache: cache of ground truth and views.
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
    _ground_truths: dict[str, GroundTruth] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        _ = self._source_code  # read now: its files may be edited while scenes are rendered

    def __getstate__(self) -> dict[str, Any]:
        # renderers cannot be pickled, and another process may run other code
        kept = {name: value for name, value in self.__dict__.items() if name != "_source_code"}
        return {**kept, "_loaded": {}, "_ground_truths": {}}

    def scene(self, name: str) -> Scene:
        """Return a scene; each process loads it once."""
        return self._load(name)[0]

    def ground_truth(self, name: str) -> GroundTruth:
        """Return the ground-truth maps of a scene, from the cache if they are there."""
        if name not in self._ground_truths:
            arrays = self.cache.get_or_build(
                "ground_truth", self.ground_truth_key(name), lambda: self._build_ground_truth(name)
            )
            self._ground_truths[name] = GroundTruth.from_arrays(arrays)
        return self._ground_truths[name]

    def observe(self, name: str, pose: Pose, rng: np.random.Generator) -> View:
        """Render the view from `pose` in a scene; `rng` is used for sensor noise only.

        Raises:
            UserError: if the scene does not exist or the pose is not finite.
        """
        scene, renderer = self._load(name)
        image = self.sensor(renderer.render(self.camera, self.camera.to_world(pose, scene.floor_height)), rng)
        ground_truth = self.ground_truth(name)
        ego = project_depth(image.depth, self.camera, self.ego, self.obstacles)
        lookup = scene.category_of_instance(self.categories.names)
        categories = np.where(image.instance < 0, np.uint8(0), lookup[np.maximum(image.instance, 0)])
        target = crop(ground_truth.truth, ground_truth.grid, pose, self.ego)
        return View(pose, image.rgb, image.depth, categories, ego.occupied, ego.seen, target)

    def forget(self, name: str) -> None:
        """Release a scene that is not rendered again, with its ground truth."""
        self._loaded.pop(name, None)
        self._ground_truths.pop(name, None)

    def fingerprint(self, name: str) -> str:
        """Return a hash that changes whenever a scene changes, be it by data, settings or the code of its source."""
        text = json.dumps([self.source.fingerprint(name), self._source_code])
        return hashlib.sha256(text.encode()).hexdigest()

    def ground_truth_key(self, name: str) -> dict[str, Any]:
        """Return everything that the ground truth of a scene depends on."""
        return {
            "scene": self.fingerprint(name),
            "spec": as_plain(self.ground_truth_spec),
            "categories": self.categories.labels,
        }

    def view_key(self, name: str) -> dict[str, Any]:
        """Return everything that views of a scene depend on except poses and random numbers."""
        parts = {"camera": self.camera, "sensor": self.sensor, "ego": self.ego, "obstacles": self.obstacles}
        return {**self.ground_truth_key(name), **{part: as_plain(value) for part, value in parts.items()}}

    @cached_property
    def _source_code(self) -> dict[str, str]:
        return plugin_code(self.source)

    def _load(self, name: str) -> tuple[Scene, SceneRenderer]:
        if name not in self._loaded:
            scene = self.source.load(name)
            self._loaded[name] = scene, renderer_of(scene)
        return self._loaded[name]

    def _build_ground_truth(self, name: str) -> dict[str, np.ndarray]:
        scene, renderer = self._load(name)
        return build(scene, renderer, self.ground_truth_spec, self.categories).to_arrays()
