"""Replay-buffer callback, which collects views before each epoch and provides the batches of the epoch."""

from collections.abc import Callable, Iterator, Mapping, Sized
from time import perf_counter
from typing import cast

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from imagination.data.augmentation import mirrored
from imagination.data.collate import Batch
from imagination.data.datamodule import SceneData
from imagination.data.prefetch import prefetch
from imagination.data.replay_buffer import ReplayBuffer
from imagination.models.lit_task import LitTask
from imagination.utils.errors import UserError, check_range
from imagination.utils.process_group import global_rank, world_size
from imagination.utils.progress import progress
from imagination.views.collector import Collector, Views
from imagination.views.random_streams import Stream


class ReplayBufferCallback(Callback):
    """Callback that collects views before each epoch and provides its batches from a replay buffer.

    An epoch collects `update_interval` steps and trains on `update_batches` batches. The workers collect one epoch
    ahead of training. The views and batches of an epoch depend only on the seed and the epoch, so that the epoch in a
    checkpoint suffices to resume.

    Args:
        size: capacity of the buffer, views.
        update_interval: number of collection steps per epoch; a step is one view in each parallel scene.
        update_batches: number of batches per epoch.
        aggregation_factor: fraction of older views in a batch; the rest comes from the newest collection.
        prefill_steps: number of collection steps before the first epoch, a multiple of `update_interval`.
        hflip_probability: probability that a view in a batch is flipped horizontally.
        collection_epochs: number of epochs that collect views. Later epochs reuse the views in the buffer or, if the
            buffer does not hold all collections, repeat the collections in their order.

    Raises:
        UserError: if a value is out of range.
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
        self._next = 0  # index of the next collection to insert
        self._started: dict[int, Callable[[], Views]] = {}  # functions that wait for collections, by index

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
        if world_size() > 1:  # each process has a part of the buffer
            self.buffer = ReplayBuffer(self.buffer.size // world_size(), self.buffer.aggregation_factor)
        per_process = data.batch_size // world_size()
        check_range("data.micro_batches", data.micro_batches, 1, per_process, "micro-batches")
        data.epochs = _EpochBatches(self, data, trainer, cast(LitTask, pl_module))

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
        collector = data.collector(self.update_interval)
        total = self.prefill + self.collection_epochs
        holds_all = total * collector.views_per_collection <= self.buffer.size
        newest = self.prefill + drawn_epoch(trainer)
        newest = min(newest, total - 1) if holds_all else newest
        start = perf_counter()
        self._fill(data, collector, newest, 2 * max(1, data.workers))
        last = trainer.current_epoch + 1 >= (trainer.max_epochs or 0) or overfits(trainer)
        if holds_all and drawn_epoch(trainer) >= self.collection_epochs:
            self.buffer.settle()
        elif not last and not (holds_all and newest + 1 == total):
            self._start(collector, newest + 1)  # renders while this epoch trains
        collected = min(newest + 1, total) * collector.views_per_collection * world_size()
        pl_module.log("data/collecting_seconds", perf_counter() - start)
        pl_module.log("data/collected_views", float(collected))
        # arguments of the trainer such as limit_train_batches may skip batches
        batches = self.update_batches * trainer.num_training_batches / len(cast(Sized, data.epochs))
        draws = batches * data.batch_size * (trainer.current_epoch + 1)
        pl_module.log("data/draws_per_view", draws / collected)

    def _fill(self, data: SceneData, collector: Collector, newest: int, lookahead: int) -> None:
        """Insert the collections up to `newest` that fit into the buffer; start `lookahead` collections in advance."""
        capacity = -(-self.buffer.size // collector.views_per_collection)
        indices = range(max(self._next, newest + 1 - capacity), newest + 1)
        for index in progress(indices, "collecting views") if len(indices) > 1 else indices:
            for upcoming in range(index, min(index + lookahead, newest + 1)):
                self._start(collector, upcoming)
            views = self._started.pop(index)()
            self.buffer.insert({name: views[name] for name in data.fields})
        self._next = newest + 1

    def _start(self, collector: Collector, index: int) -> None:
        if index not in self._started:
            self._started[index] = collector.start(index % (self.prefill + self.collection_epochs))


DRAWING_THREADS = 4
"""Number of prefetch threads on a GPU: at the paper's scale, drawing a batch takes as long as a step on an H100."""


class _EpochBatches:
    """Batches of the current epoch, drawn in the main process: prefetched if a GPU trains, otherwise on demand."""

    def __init__(
        self, callback: ReplayBufferCallback, data: SceneData, trainer: Trainer, task: LitTask
    ) -> None:
        self.callback, self.data, self.trainer, self.task = callback, data, trainer, task

    def __len__(self) -> int:
        return self.callback.update_batches * self.data.micro_batches

    def __iter__(self) -> Iterator[Batch]:
        threads = DRAWING_THREADS if self._on_gpu else 0
        for micro_batches in prefetch(self._batch, self.callback.update_batches, threads):
            yield from micro_batches

    @property
    def _on_gpu(self) -> bool:
        return self.trainer.strategy.root_device.type == "cuda"

    def _batch(self, number: int) -> list[Batch]:
        """Draw a batch of the current epoch, divided into micro-batches."""
        per_process = self.data.batch_size // world_size()
        index = number * world_size() + global_rank()
        rng = np.random.default_rng([self.data.seed, Stream.BATCHES, drawn_epoch(self.trainer), index])
        views = self.callback.buffer.draw(per_process, rng)
        flipped = rng.random(per_process) < self.callback.hflip_probability
        batch = self.data.assemble(mirrored(views, flipped))
        micro_batches = parts(batch, self.data.micro_batches, self.task.batch_totals)
        return [pinned(part) for part in micro_batches] if self._on_gpu else list(micro_batches)


def pinned(batch: Batch) -> Batch:
    """Copy a batch to pinned memory, from which a transfer to a GPU is ten times as fast."""
    return {name: values.pin_memory() for name, values in batch.items()}


def overfits(trainer: Trainer) -> bool:
    """Return whether the trainer fits the same few batches in every epoch (`trainer.overfit_batches`)."""
    return bool(trainer.overfit_batches)  # type: ignore[attr-defined]  # Lightning sets it at runtime


def drawn_epoch(trainer: Trainer) -> int:
    """Return the epoch whose views and batches are drawn: always the first one if the trainer overfits."""
    return 0 if overfits(trainer) else trainer.current_epoch


def parts(batch: Batch, count: int, batch_totals: Callable[[Batch], Mapping[str, Tensor]]) -> Iterator[Batch]:
    """Yield `count` micro-batches of a batch, whose losses add up to that of the batch.

    Args:
        batch: whole batch.
        count: number of micro-batches, which each of them holds as well.
        batch_totals: function that returns the entries of the micro-batches that describe the whole batch.
    """
    if count == 1:
        yield batch
        return
    totals = batch_totals(batch)
    for first in range(count):
        part = {name: values[first::count].clone() for name, values in batch.items()}
        yield {**part, **totals, "micro_batches": torch.tensor(count)}
