"""The replay buffer as a callback: collects before each round and hands the round's batches to training."""

from collections.abc import Callable, Iterator
from time import perf_counter

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer

from imagination.config.key_roles import MICRO_BATCH_KEYS
from imagination.data.augmentation import mirrored
from imagination.data.collate import Batch
from imagination.data.datamodule import SceneData
from imagination.data.prefetch import ahead
from imagination.data.replay_buffer import ReplayBuffer
from imagination.models.losses import batch_counts
from imagination.utils.errors import UserError, check_range
from imagination.utils.process_group import global_rank, world_size
from imagination.utils.progress import progress
from imagination.views.collector import Collector, Views
from imagination.views.random_streams import Stream


class ReplayBufferCallback(Callback):
    """One epoch is one round: collect `update_interval` steps, then train on `update_batches` batches from the buffer.

    Collecting runs one round ahead of training in the workers. Which views and batches a round gets depends on the
    seed and the round alone: the epoch in a checkpoint is the collector's position, and nothing else has to be saved.

    Args:
        size: views that the buffer keeps.
        update_interval: collection steps (one look in each parallel scene) in a round.
        update_batches: batches trained on in a round.
        aggregation_factor: share of a batch from older views, the rest from the newest collection.
        prefill_steps: collection steps before the first round, a multiple of `update_interval`.
        hflip_probability: of the views in batches, seen in a mirror.
        collection_epochs: epochs that collect; those after them train on what is there, and where the buffer does not
            hold all of it, go through the same collections again.
    """

    def __init__(
        self,
        size: int,
        update_interval: int,
        update_batches: int,
        aggregation_factor: float,
        prefill_steps: int,
        hflip_probability: float,
        collection_epochs: int,
    ) -> None:
        self.buffer = ReplayBuffer(size, aggregation_factor)
        self.update_interval = int(
            check_range("update_interval", update_interval, 1, 10_000, "collection steps")
        )
        self.update_batches = int(check_range("update_batches", update_batches, 1, 100_000, "batches"))
        if prefill_steps < 0 or prefill_steps % self.update_interval:
            raise UserError(
                f"prefill_steps: got {prefill_steps}, expected a multiple of update_interval = {self.update_interval}"
            )
        self.prefill = prefill_steps // self.update_interval
        self.hflip_probability = check_range("hflip_probability", hflip_probability, 0.0, 1.0)
        self.collection_epochs = int(check_range("collection_epochs", collection_epochs, 1, 10**9, "epochs"))
        self._resident = 0  # collections that this process has inserted or passed over as too old
        self._started: dict[int, Callable[[], Views]] = {}

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
        if world_size() > 1:  # each keeps its part
            self.buffer = ReplayBuffer(self.buffer.size // world_size(), self.buffer.aggregation_factor)
        share = data.batch_size // world_size()
        check_range(
            MICRO_BATCH_KEYS[data.predicts],
            trainer.accumulate_grad_batches,
            1,
            share,
            "parts of a process's batch",
        )
        data.epochs = _Rounds(self, data, trainer)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
        collector = data.collector(self.update_interval)
        every = self.prefill + self.collection_epochs
        all_held = every * collector.views_per_collection <= self.buffer.size
        newest = self.prefill + trainer.current_epoch
        newest = min(newest, every - 1) if all_held else newest
        begin = perf_counter()
        self._fill(data, collector, newest, 2 * max(1, data.workers))
        if all_held and trainer.current_epoch >= self.collection_epochs:
            self.buffer.settle()
        elif trainer.current_epoch + 1 < (trainer.max_epochs or 0) and not (all_held and newest + 1 == every):
            self._start(collector, newest + 1)  # renders while this round trains
        collected = min(newest + 1, every) * collector.views_per_collection * world_size()
        pl_module.log("data/collecting_seconds", perf_counter() - begin)
        pl_module.log("data/collected_views", float(collected))
        pl_module.log(
            "data/draws_per_view",
            self.update_batches * data.batch_size * (trainer.current_epoch + 1) / collected,
        )

    def _fill(self, data: SceneData, collector: Collector, newest: int, early: int) -> None:
        """Insert every collection up to `newest` that still has a place in the buffer."""
        kept = -(-self.buffer.size // collector.views_per_collection)
        wanted = range(max(self._resident, newest + 1 - kept), newest + 1)
        shown = progress(wanted, "collecting views") if len(wanted) > 1 else wanted
        for index in shown:
            for later in range(index, min(index + early, newest + 1)):
                self._start(collector, later)
            views = self._started.pop(index)()
            self.buffer.insert({name: views[name] for name in data.fields})
        self._resident = newest + 1

    def _start(self, collector: Collector, index: int) -> None:
        if index not in self._started:
            self._started[index] = collector.start(index % (self.prefill + self.collection_epochs))


DRAWING_THREADS = 4
"""That draw batches while a GPU trains on earlier ones: at the paper's scale one takes as long as a step of an H100."""


class _Rounds:
    """What training iterates over: the batches of the current round, drawn in the main process.

    When asked for, where the processor trains too; ahead of it, where a GPU does.
    """

    def __init__(self, callback: ReplayBufferCallback, data: SceneData, trainer: Trainer) -> None:
        self.callback, self.data, self.trainer = callback, data, trainer

    def __len__(self) -> int:
        return self.callback.update_batches * self.trainer.accumulate_grad_batches

    def __iter__(self) -> Iterator[Batch]:
        threads = DRAWING_THREADS if self._on_gpu else 0
        for batch in ahead(self._batch, self.callback.update_batches, threads):
            yield from batch

    @property
    def _on_gpu(self) -> bool:
        return self.trainer.strategy.root_device.type == "cuda"

    def _batch(self, number: int) -> list[Batch]:
        """A batch of the current round, in the parts that it is trained in."""
        share, place = self.data.batch_size // world_size(), number * world_size() + global_rank()
        rng = np.random.default_rng([self.data.seed, Stream.BATCHES, self.trainer.current_epoch, place])
        views = self.callback.buffer.draw(share, rng)
        which = rng.random(share) < self.callback.hflip_probability
        batch = self.data.assemble(mirrored(views, which))
        cut = parts(batch, self.trainer.accumulate_grad_batches)
        return [pinned(part) for part in cut] if self._on_gpu else list(cut)


def pinned(batch: Batch) -> Batch:
    """The same in memory that is copied to a GPU ten times as fast."""
    return {name: values.pin_memory() for name, values in batch.items()}


def parts(batch: Batch, count: int) -> Iterator[Batch]:
    """A batch in `count` parts for gradient accumulation, each with what weighs its loss as a part of the whole.

    Maps get the counts of `batch_counts`, first-person images the number of views.
    """
    if count == 1:
        yield batch
        return
    if "label" in batch:
        whole = {"counts": batch_counts(batch["label"], batch["neighbourhood"])}
    else:
        whole = {"views": torch.tensor(len(batch["rgb"]))}
    for first in range(count):
        yield {**{name: values[first::count].clone() for name, values in batch.items()}, **whole}
