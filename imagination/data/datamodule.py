"""Data of a run: scenes, the views rendered in them, and batches of these views."""

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
from lightning import LightningDataModule
from torch.utils.data import DataLoader

from imagination.data.batches import EpochBatches
from imagination.data.collate import Batch, Collate, MapCollate
from imagination.data.collection import CollectedViews, ViewCollector
from imagination.data.replay_buffer import ReplaySettings
from imagination.geometry.morphology import kernel_cells
from imagination.scenes.source import SPLITS, Split
from imagination.utils.cache_key import as_plain
from imagination.utils.errors import UserError, check_choice, check_range
from imagination.utils.process_group import global_rank, rotated_by_rank, world_size
from imagination.utils.progress import progress
from imagination.views.collector import Collector, PoseSampler, Views, concatenate, render_views
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream
from imagination.views.scene_workers import ScenePool

TRAINING_SCENES = "training_scenes"
"""Key, in the state of the data module in a checkpoint, of the fingerprints of the training scenes by identity."""


class SceneData(LightningDataModule):
    """Batches of views rendered in the scenes of a scene source.

    Training batches are drawn from a replay buffer, into which each epoch collects views. Validation and test batches
    hold fixed views, which are the same in every run, whatever its seed.

    Args:
        observer: renderer of views and their egocentric maps.
        unit_categories: names of the categories that the unit imagines.
        sampler: sampler of training poses.
        eval_sampler: sampler of validation and test poses.
        imaginable: side of the kernel δ, metres.
        neighbourhood: side of the kernel ε, metres.
        seed: seed of the run.
        parallel_scenes: number of scenes in one collection, summed over all training processes.
        batch_size: number of views in a batch, summed over all training processes; validation and test batches hold
            up to twice as many.
        eval_views: number of validation and test views.
        workers: number of rendering processes; 0 renders in the main process.
        micro_batches: number of parts of a training batch, which are computed one after the other to save memory.
        collate: function that assembles batches, that of the task.
        hflip_probability: probability that a view in a training batch is flipped horizontally.
        replay: settings of the replay buffer; None if the module is not used for training.

    Raises:
        UserError: if a value is out of range or a category is unknown.
    """

    fit_splits: ClassVar[Sequence[Split]] = ("train", "val")
    """Splits whose scenes and ground truth are built before a training."""

    def __init__(
        self,
        observer: Observer,
        unit_categories: Sequence[str],
        sampler: PoseSampler,
        eval_sampler: PoseSampler,
        imaginable: float,
        neighbourhood: float,
        seed: int,
        parallel_scenes: int,
        batch_size: int,
        eval_views: Mapping[Split, int],
        workers: int,
        micro_batches: int = 1,
        collate: Collate = MapCollate(),  # noqa: B008  (stateless)
        hflip_probability: float = 0.0,
        replay: ReplaySettings | None = None,
    ) -> None:
        super().__init__()
        self.observer = observer
        self.collate = collate
        self.unit_categories = list(unit_categories)
        self.layers = [observer.categories.index(name) - 1 for name in unit_categories]
        self.sampler, self.eval_sampler = sampler, eval_sampler
        self.imaginable = kernel_cells(imaginable, observer.ego.resolution)
        self.neighbourhood = kernel_cells(neighbourhood, observer.ego.resolution)
        self.seed = seed
        self.parallel_scenes = parallel_scenes
        self.batch_size = int(check_range("batch_size", batch_size, 1, 100_000, "views"))
        self.eval_views = dict(eval_views)
        self.workers = workers
        self.micro_batches = micro_batches
        self.hflip_probability = check_range("data.hflip_probability", hflip_probability, 0.0, 1.0)
        self.replay = replay
        self._collected: CollectedViews | None = None
        self._pool: ScenePool | None = None
        self._surveyed: set[Split] = set()
        self._eval_views: dict[Split, Views] = {}

    @property
    def pool(self) -> ScenePool:
        """Pool of rendering workers, started at first use and kept until `close`."""
        if self._pool is None:
            self._pool = ScenePool(self.observer, self.workers)
        return self._pool

    @property
    def collected(self) -> CollectedViews:
        """Collected training views of this process, empty at first use and kept until `close`.

        Raises:
            UserError: if the module has no settings of the replay buffer.
        """
        if self._collected is None:
            settings = self._replay_settings()
            make_collector = partial(self.collector, settings.update_interval)
            lookahead = 2 * max(1, self.workers)
            self._collected = CollectedViews(settings, make_collector, self.fields, lookahead)
        return self._collected

    def close(self) -> None:
        """Stop the rendering workers and drop the replay buffer."""
        self._collected = None
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def setup(self, stage: str) -> None:
        if stage == "fit":
            self._replay_settings()  # refused before scenes are built
        splits: dict[str, Sequence[Split]] = {
            "fit": self.fit_splits,
            "validate": ["val"],
            "test": ["test"],
            "predict": ["test"],
        }
        for split in splits[stage]:
            self.survey(split)

    def teardown(self, stage: str) -> None:
        self.close()

    def on_exception(self, exception: BaseException) -> None:
        self.close()

    def survey(self, split: Split) -> None:
        """Build the scenes of a split and their ground truth in parallel.

        Raises:
            UserError: if no scene of the split contains one of the unit's categories.
        """
        if split in self._surveyed:
            return
        names = rotated_by_rank(self.observer.source.scenes(split))
        tasks = [self.pool.submit(count_ground_truth, name) for name in names]
        counts = np.array([task.result() for task in progress(tasks, f"scenes and ground truth ({split})")])
        for name, layer in zip(self.unit_categories, self.layers, strict=True):
            if not counts[:, layer].any():
                raise UserError(
                    f"category {name!r}: got no object in the {len(names)} scenes of the split {split!r}, expected at "
                    "least one; choose another category or scene source, or use more scenes"
                )
        self._surveyed.add(split)

    def collector(self, steps: int) -> ViewCollector:
        """Return the collector of training views, with `steps` steps per collection.

        Training processes divide the scenes and the parallel scenes among themselves.
        """
        scenes = self.observer.source.scenes("train")[global_rank() :: world_size()]
        parallel = self.parallel_scenes // world_size()
        return Collector(
            self.pool, scenes, self.sampler, self.seed, parallel, steps, first_slot=global_rank() * parallel
        )

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the arrays of views that `assemble` needs."""
        return self.collate.fields

    def assemble(self, views: Views) -> Batch:
        """Assemble a batch for the unit's categories."""
        return self.collate(views, self.layers, self.imaginable, self.neighbourhood)

    def train_dataloader(self) -> EpochBatches:
        """Return the loader of training batches, which reads the epoch of the trainer."""
        per_process = self.batch_size // world_size()
        check_range("data.micro_batches", self.micro_batches, 1, per_process, "micro-batches")
        return EpochBatches(
            self.collected,
            self.assemble,
            per_process,
            self.micro_batches,
            self.hflip_probability,
            self.seed,
            self.trainer,
        )

    def _replay_settings(self) -> ReplaySettings:
        """Return the settings of the replay buffer.

        Raises:
            UserError: if there are none.
        """
        if self.replay is None:
            raise UserError(
                "callbacks.replay_buffer: got none, expected the settings of the replay buffer for training; "
                "add replay_buffer to callbacks"
            )
        return self.replay

    def state_dict(self) -> dict[str, Any]:
        """Return the training scenes for checkpoints, so that an evaluation can refuse to use them."""
        return {TRAINING_SCENES: self.training_scenes}

    @cached_property
    def training_scenes(self) -> dict[str, str]:
        """Fingerprints of the training scenes by identity."""
        return self._fingerprints(self.observer.source.scenes("train"))

    def _fingerprints(self, scenes: Sequence[str]) -> dict[str, str]:
        source = self.observer.source
        return {source.identity(scene): self.observer.fingerprint(scene) for scene in scenes}

    def val_dataloader(self) -> DataLoader[Batch]:
        return self._eval_dataloader("val")

    def test_dataloader(self) -> DataLoader[Batch]:
        return self._eval_dataloader("test")

    def predict_dataloader(self) -> DataLoader[Batch]:
        """Return the test views; `scene_dataloader` returns those of one scene."""
        return self._eval_dataloader("test")

    def scene_dataloader(self, scene: str, count: int, index: int = 0) -> DataLoader[Batch]:
        """Return views of one scene, e.g. for `trainer.predict(task, data.scene_dataloader("test_0003", 8))`.

        Args:
            scene: name of the scene.
            count: number of views.
            index: seed of the poses.

        Raises:
            UserError: if the source has no such scene.
        """
        names = [name for split in SPLITS for name in self.observer.source.scenes(split)]
        check_choice("scene", scene, names)
        views = self.pool.submit(eval_views, scene, self.eval_sampler, index, count).result()
        return self._batches(views)

    def _eval_dataloader(self, split: Split) -> DataLoader[Batch]:
        if split not in self._eval_views:
            self._eval_views[split] = self._render_eval_views(split)
        return self._batches(self._eval_views[split])

    def _batches(self, views: Views) -> DataLoader[Batch]:
        """Return a loader of views in their order."""
        count = max(len(views["pose"]) // self.batch_size, 1)  # no batch is smaller than in training
        parts = {name: np.array_split(values, count) for name, values in views.items()}
        batches = [  # each rank takes every world_size-th view of a batch, without overlap
            self.assemble({name: part[index][global_rank() :: world_size()] for name, part in parts.items()})
            for index in range(count)
        ]
        return DataLoader(batches, batch_size=None)  # type: ignore[arg-type]  # a list is a map-style data set

    def _render_eval_views(self, split: Split) -> Views:
        """Return the fixed views of a split, spread evenly over its scenes."""
        names = self.observer.source.scenes(split)
        per_scene, remainder = divmod(self.eval_views[split], len(names))
        counts = [per_scene + (index < remainder) for index in range(len(names))]
        tasks = [
            self.pool.submit(eval_views, name, self.eval_sampler, index, count)
            for index, (name, count) in enumerate(zip(names, counts, strict=True))
            if count
        ]
        return concatenate([task.result() for task in progress(tasks, f"evaluation views ({split})")])


def count_ground_truth(observer: Observer, scene: str) -> list[int]:
    """Return the number of ground-truth cells of each category in a scene; build its maps if they are not cached."""
    counts: list[int] = observer.ground_truth(scene).truth.sum(axis=(1, 2)).tolist()
    return counts


def eval_views(observer: Observer, scene: str, sampler: PoseSampler, index: int, count: int) -> Views:
    """Return the evaluation views of a scene, which are the same in every run, from the cache if they are stored.

    Args:
        observer: renderer of views.
        scene: name of the scene.
        sampler: sampler of poses.
        index: index of the scene in its split, which seeds the poses.
        count: number of views.
    """
    key: dict[str, Any] = {
        "view": observer.view_key(scene),
        "sampler": as_plain(sampler),
        "place": index,
        "count": count,
    }
    seed = (0, Stream.EVAL_VIEWS, index)
    return observer.cache.get_or_build(
        "views", key, lambda: render_views(observer, scene, sampler, seed, count)
    )
