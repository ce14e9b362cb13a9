"""Training batches: the loader of an epoch, which draws them from the replay buffer, and their micro-batches."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from lightning import Trainer
from torch import Tensor

from imagination.data.augmentation import mirrored
from imagination.data.collate import Batch
from imagination.data.collection import CollectedViews
from imagination.data.prefetch import prefetch
from imagination.utils.errors import UserError
from imagination.utils.process_group import global_rank, world_size
from imagination.views.collector import Views
from imagination.views.random_streams import Stream

DRAWING_THREADS = 4
"""Number of prefetch threads on a GPU: at the paper's scale, drawing a batch takes as long as a step on an H100."""


@dataclass(frozen=True)
class EpochBatches:
    """Batches of the trainer's current epoch, as a sized iterable.

    An iterator reads the epoch and collects its views when its first batch is requested, because Lightning creates
    iterators before the epoch starts. The main process draws the batches: prefetched if a GPU trains, otherwise on
    demand. They depend only on the seed and the epoch.

    Attributes:
        collected: collected views of this process.
        assemble: function that assembles a batch from views.
        batch_size: number of views in a batch of this process.
        micro_batches: number of parts of a batch, which are yielded one after the other.
        hflip_probability: probability that a view in a batch is flipped horizontally.
        seed: seed of the run.
        trainer: trainer whose epoch is read; without one, the batches are those of the first epoch.
    """

    collected: CollectedViews
    assemble: Callable[[Views], Batch]
    batch_size: int
    micro_batches: int
    hflip_probability: float
    seed: int
    trainer: Trainer | None

    def __len__(self) -> int:
        return self.collected.settings.update_batches * self.micro_batches

    def __iter__(self) -> Iterator[Batch]:
        epoch = drawn_epoch(self.trainer)
        self.collected.collect(epoch, ahead=draws_another_epoch(self.trainer))
        threads = DRAWING_THREADS if self._on_gpu else 0
        draw = partial(self._draw, epoch)
        for micro_batches in prefetch(draw, self.collected.settings.update_batches, threads):
            yield from micro_batches

    def _draw(self, epoch: int, number: int) -> list[Batch]:
        """Draw batch `number` of an epoch, divided into micro-batches."""
        index = number * world_size() + global_rank()
        rng = np.random.default_rng([self.seed, Stream.BATCHES, epoch, index])
        views = self.collected.buffer.draw(self.batch_size, rng)
        flipped = rng.random(self.batch_size) < self.hflip_probability
        batch = self.assemble(mirrored(views, flipped))
        micro_batches = parts(batch, self.micro_batches, self._batch_totals)
        return [pinned(part) for part in micro_batches] if self._on_gpu else list(micro_batches)

    @property
    def _on_gpu(self) -> bool:
        return self.trainer is not None and self.trainer.strategy.root_device.type == "cuda"

    def _batch_totals(self, batch: Batch) -> Mapping[str, Tensor]:
        """Return the entries of micro-batches that describe their whole batch, as the trained module needs them."""
        if self.trainer is None:
            raise UserError(
                f"data.micro_batches: got {self.micro_batches} without a trainer, expected 1; iterate over the loader "
                "in trainer.fit, or set data.micro_batches=1"
            )
        totals: Mapping[str, Tensor] = cast(Any, self.trainer.lightning_module).batch_totals(batch)
        return totals


def overfits(trainer: Trainer) -> bool:
    """Return whether the trainer fits the same few batches in every epoch (`trainer.overfit_batches`)."""
    return bool(trainer.overfit_batches)  # type: ignore[attr-defined]  # Lightning sets it at runtime


def drawn_epoch(trainer: Trainer | None) -> int:
    """Return the epoch whose views and batches are drawn: the first one if the trainer overfits, or without one."""
    return 0 if trainer is None or overfits(trainer) else trainer.current_epoch


def draws_another_epoch(trainer: Trainer | None) -> bool:
    """Return whether the trainer will draw the views and batches of another epoch after the current one."""
    if trainer is None or overfits(trainer):
        return False
    return trainer.current_epoch + 1 < (trainer.max_epochs or 0)


def pinned(batch: Batch) -> Batch:
    """Copy a batch to pinned memory, from which a transfer to a GPU is ten times as fast."""
    return {name: values.pin_memory() for name, values in batch.items()}


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
