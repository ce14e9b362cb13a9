"""Collection of training views: every view is a pure function of the seed and its index in the collection.

A collection consists of `steps` views in each of `parallel_scenes` scenes (the paper's "observations are randomly
selected in 16 different scenes at the same time"). Collections are independent of each other, so each can be reproduced
by any number of workers in any order; finished collections are cached.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from imagination.geometry.pose import Pose
from imagination.scenes.scene import Scene
from imagination.utils.cache_key import as_plain
from imagination.utils.errors import UserError, check_range
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream
from imagination.views.scene_workers import ScenePool
from imagination.views.view import View

Views = dict[str, np.ndarray]
"""Stacked views, compact: rgb and categories uint8, depth float16, occupied, seen and object bool, pose float64."""


@runtime_checkable
class PoseSampler(Protocol):
    """Sampler of poses in the free space of a scene."""

    def __call__(self, scene: Scene, count: int, rng: np.random.Generator) -> list[Pose]:
        """Return `count` poses."""


def stack(views: Sequence[View]) -> Views:
    """Stack views into arrays with a leading axis; depth becomes float16 (4 mm at 8 m)."""
    return {
        "rgb": np.stack([view.rgb for view in views]),
        "depth": np.stack([view.depth for view in views]).astype(np.float16),
        "categories": np.stack([view.categories for view in views]),
        "occupied": np.stack([view.occupied for view in views]),
        "seen": np.stack([view.seen for view in views]),
        "object": np.stack([view.object for view in views]),
        "pose": np.array([view.pose for view in views], np.float64),
    }


def concatenate(parts: Iterable[Views]) -> Views:
    """Concatenate several stacks of views."""
    stacks = list(parts)
    return {name: np.concatenate([part[name] for part in stacks]) for name in stacks[0]}


def render_views(
    observer: Observer, scene: str, sampler: PoseSampler, seed: Sequence[int], count: int
) -> Views:
    """Render `count` views of a scene from poses that `sampler` draws; the same seed gives the same views."""
    rng = np.random.default_rng(list(seed))
    poses = sampler(observer.scene(scene), count, rng)
    return stack([observer.observe(scene, pose, rng) for pose in poses])


@dataclass(frozen=True)
class Collector:
    """Collector of training views.

    Attributes:
        pool: worker processes that render the views.
        scenes: names of the training scenes.
        sampler: sampler of poses in a scene.
        seed: random seed of the run.
        parallel_scenes: number of scenes in one collection.
        steps: number of views in each scene.
        first_slot: index of the first scene slot of this process among the slots of all processes.
    """

    pool: ScenePool
    scenes: Sequence[str]
    sampler: PoseSampler
    seed: int
    parallel_scenes: int
    steps: int
    first_slot: int = 0

    def __post_init__(self) -> None:
        check_range("parallel_scenes", self.parallel_scenes, 1, 4096)
        check_range("update_interval", self.steps, 1, 10_000, "collection steps")
        if not self.scenes:
            raise UserError("collector: got 0 training scenes, expected at least 1; raise data.splits.train")

    @property
    def views_per_collection(self) -> int:
        return self.parallel_scenes * self.steps

    def start(self, index: int) -> Callable[[], Views]:
        """Start collection `index` and return a function that waits for its views.

        Scenes are visited in random order without replacement; after the last one a new order is drawn.
        """
        slots = [self._scene_of(index * self.parallel_scenes + slot) for slot in range(self.parallel_scenes)]
        observer = self.pool.observer
        key = {
            "views": {scene: observer.view_key(scene) for scene in sorted(set(slots))},
            "slots": slots,
            "sampler": as_plain(self.sampler),
            "seed": [self.seed, index, self.first_slot],
            "steps": self.steps,
        }
        if (cached := observer.cache.load("views", key)) is not None:
            return lambda: cached
        parts = [
            self.pool.submit(
                render_views, scene, self.sampler, (self.seed, Stream.TRAINING_VIEWS, index, slot), self.steps
            )
            for slot, scene in enumerate(slots, start=self.first_slot)
        ]

        def wait() -> Views:
            views = concatenate(part.result() for part in parts)
            observer.cache.store("views", key, views)
            return views

        return wait

    def _scene_of(self, position: int) -> str:
        cycle, index = divmod(position, len(self.scenes))
        order: list[int] = (
            np.random.default_rng([self.seed, Stream.SCENE_ORDER, cycle])
            .permutation(len(self.scenes))
            .tolist()
        )
        return self.scenes[order[index]]
