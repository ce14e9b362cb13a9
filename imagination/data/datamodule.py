"""The data of a run: scenes, the views looked at in them, and batches made of these."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from lightning import LightningDataModule
from torch.utils.data import DataLoader

from imagination.data.collate import FIELDS, Batch, assemble, assemble_images
from imagination.geometry.morphology import kernel_cells
from imagination.scenes.source import Split
from imagination.utils.cache import as_plain
from imagination.utils.errors import UserError, check_choice, check_range
from imagination.utils.process_group import global_rank, rotated_by_rank, world_size
from imagination.utils.progress import progress
from imagination.views.collector import Collector, PoseSampler, Views, concatenate, look
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream
from imagination.views.scene_workers import ScenePool


class SceneData(LightningDataModule):
    """Views of a scene source's scenes, as batches.

    Training batches come from the replay-buffer callback, which puts them into `epochs`; those of validation and test
    are the same fixed views in each run, whatever its seed.

    Args:
        observer: what a view looks like.
        unit_categories: names of the categories that the unit imagines.
        sampler: draws training poses in a scene.
        eval_sampler: draws the poses of validation and test views.
        imaginable: kernel delta, metres.
        neighbourhood: kernel epsilon, metres.
        seed: of the run.
        parallel_scenes: scenes looked at in one collection.
        batch_size: views in a batch, of all processes that train together; in validation and test up to twice as many.
        eval_views: number of views for validation and test.
        workers: processes that render; 0 renders in the main process.
        predicts: what batches are for: networks of egocentric "maps", or of first-person "images".

    Raises:
        UserError: on a value out of range or an unknown category.
    """

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
        predicts: str = "maps",
    ) -> None:
        super().__init__()
        self.observer = observer
        self.predicts = check_choice("model.predicts", predicts, FIELDS)
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
        self.epochs: Iterable[Batch] | None = None
        self._pool: ScenePool | None = None
        self._surveyed: set[Split] = set()
        self._held_out: dict[Split, Views] = {}

    @property
    def pool(self) -> ScenePool:
        """The workers that render, started at first use and kept until `close`."""
        if self._pool is None:
            self._pool = ScenePool(self.observer, self.workers)
        return self._pool

    def close(self) -> None:
        """Stop the workers."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def setup(self, stage: str) -> None:
        splits: dict[str, list[Split]] = {"fit": ["train", "val"], "validate": ["val"], "test": ["test"]}
        for split in splits.get(stage, []):
            self.survey(split)

    def survey(self, split: Split) -> None:
        """Build the scenes of a split and their ground truth, in parallel.

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
                    f"category {name!r}: none of the {len(names)} scenes of the split {split!r} contains one; "
                    "choose another category or scene source, or more scenes"
                )
        self._surveyed.add(split)

    def collector(self, steps: int) -> Collector:
        """The collector of training views; a collection takes `steps` steps.

        Of several processes that train together, each has scenes of its own and its part of the parallel ones.
        """
        scenes = self.observer.source.scenes("train")[global_rank() :: world_size()]
        share = self.parallel_scenes // world_size()
        return Collector(
            self.pool, scenes, self.sampler, self.seed, share, steps, first_slot=global_rank() * share
        )

    @property
    def fields(self) -> tuple[str, ...]:
        """Arrays of views that `assemble` needs."""
        return FIELDS[self.predicts]

    def assemble(self, views: Views) -> Batch:
        """A batch for the unit's categories."""
        if self.predicts == "images":
            return assemble_images(views, self.layers)
        return assemble(views, self.layers, self.imaginable, self.neighbourhood)

    def train_dataloader(self) -> Iterable[Batch]:
        if self.epochs is None:
            raise UserError(
                "training: got no replay buffer; add callbacks.replay_buffer, which collects the views"
            )
        return self.epochs

    @cached_property
    def trained_homes(self) -> dict[str, str]:
        """Names and fingerprints of the scenes of training."""
        source = self.observer.source
        return {scene: source.fingerprint(scene) for scene in source.scenes("train")}

    def state_dict(self) -> dict[str, Any]:
        """Part of checkpoints: an evaluation must not look into scenes of training."""
        return {"scenes": self.trained_homes}

    def val_dataloader(self) -> DataLoader[Batch]:
        return self._batches_of("val")

    def test_dataloader(self) -> DataLoader[Batch]:
        return self._batches_of("test")

    def _batches_of(self, split: Split) -> DataLoader[Batch]:
        if split not in self._held_out:
            self._held_out[split] = self._look_at(split)
        views = self._held_out[split]
        count = max(len(views["pose"]) // self.batch_size, 1)  # so that none is smaller than in training
        parts = {name: np.array_split(values, count) for name, values in views.items()}
        batches = [  # of each batch, processes that train together take every so manieth view, none twice
            self.assemble({name: part[place][global_rank() :: world_size()] for name, part in parts.items()})
            for place in range(count)
        ]
        return DataLoader(batches, batch_size=None)  # type: ignore[arg-type]  # a list is a map-style data set

    def _look_at(self, split: Split) -> Views:
        """The fixed views of a split, spread evenly over its scenes."""
        names = self.observer.source.scenes(split)
        share, rest = divmod(self.eval_views[split], len(names))
        tasks = [
            self.pool.submit(eval_views, name, self.eval_sampler, place, share + (place < rest))
            for place, name in enumerate(names)
            if share + (place < rest)
        ]
        return concatenate([task.result() for task in progress(tasks, f"views of unseen scenes ({split})")])


def count_ground_truth(observer: Observer, scene: str) -> list[int]:
    """Cells of ground truth of each category in a scene, which builds or loads its maps."""
    truth: list[int] = observer.truth(scene).truth.sum(axis=(1, 2)).tolist()
    return truth


def eval_views(observer: Observer, scene: str, sampler: PoseSampler, place: int, count: int) -> Views:
    """Views of a scene that are the same in every run, from the cache where they are kept."""
    key: dict[str, Any] = {
        "view": observer.view_key(scene),
        "sampler": as_plain(sampler),
        "place": place,
        "count": count,
    }
    seed = (0, Stream.EVAL_VIEWS, place)
    return observer.cache.get_or_build("views", key, lambda: look(observer, scene, sampler, seed, count))
