"""Replay buffer: compact storage of the most recent views, from which batches are drawn."""

from dataclasses import dataclass

import numpy as np

from imagination.utils.errors import UserError, check_range
from imagination.views.collector import Views


@dataclass(frozen=True)
class ReplaySettings:
    """Settings of the replay buffer and of the collections that fill it: the keys `callbacks.replay_buffer.*`.

    An epoch collects `update_interval` steps and trains on `update_batches` batches.

    Attributes:
        size: capacity of the buffer, views, summed over all training processes.
        update_interval: number of collection steps per epoch; a step is one view in each parallel scene.
        update_batches: number of batches per epoch.
        aggregation_factor: fraction of older views in a batch; the rest comes from the newest collection.
        prefill_steps: number of collection steps before the first epoch, a multiple of `update_interval`.
        collection_epochs: number of epochs that collect views. Later epochs reuse the views in the buffer or, if the
            buffer does not hold all collections, repeat the collections in their order.

    Raises:
        UserError: if a value is out of range.
    """

    size: int
    update_interval: int
    update_batches: int
    aggregation_factor: float
    prefill_steps: int
    collection_epochs: int

    def __post_init__(self) -> None:
        node = "callbacks.replay_buffer"
        check_range(f"{node}.size", self.size, 1, 10_000_000, "views")
        check_range(f"{node}.update_interval", self.update_interval, 1, 10_000, "collection steps")
        check_range(f"{node}.update_batches", self.update_batches, 1, 100_000, "batches")
        check_range(f"{node}.aggregation_factor", self.aggregation_factor, 0.0, 1.0)
        check_range(f"{node}.collection_epochs", self.collection_epochs, 1, 10**9, "epochs")
        if self.prefill_steps < 0 or self.prefill_steps % self.update_interval:
            raise UserError(
                f"{node}.prefill_steps: got {self.prefill_steps}, expected a multiple of {node}.update_interval = "
                f"{self.update_interval}; change one of them"
            )

    @property
    def prefill_collections(self) -> int:
        """Number of collections before the first epoch."""
        return self.prefill_steps // self.update_interval


class ReplayBuffer:
    """Ring buffer of views: rgb as uint8, depth as float16, masks as packed bits.

    Batches mix old and new views as map registration does: a fraction `aggregation_factor` of each batch comes from
    older views, the rest from the newest collection. Without older views, the whole batch comes from the newest
    collection. No view occurs twice in a batch.

    Args:
        size: capacity, views.
        aggregation_factor: fraction of older views in a batch, 0 to 1.

    Raises:
        UserError: if a value is out of range.
    """

    def __init__(self, size: int, aggregation_factor: float) -> None:
        self.size = int(check_range("buffer size", size, 1, 10_000_000, "views"))
        self.aggregation_factor = check_range("aggregation_factor", aggregation_factor, 0.0, 1.0)
        self._store: Views = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._inserted = 0
        self._newest = 0

    def __len__(self) -> int:
        return min(self._inserted, self.size)

    def insert(self, views: Views) -> None:
        """Insert a collection as the newest one; the oldest views are overwritten.

        Raises:
            UserError: if the collection is larger than the buffer.
        """
        count = len(views["pose"])
        if count > self.size:
            raise UserError(
                f"buffer size: got {self.size} views, expected at least {count}, the size of one collection; "
                "raise callbacks.replay_buffer.size or lower data.parallel_scenes"
            )
        rows = np.arange(self._inserted, self._inserted + count) % self.size
        for name, values in views.items():
            packed = _pack(values)
            if name not in self._store:  # memory pages are allocated when they are written
                self._store[name] = np.zeros((self.size, *packed.shape[1:]), packed.dtype)
                self._shapes[name] = values.shape[1:] if values.dtype == bool else ()
            self._store[name][rows] = packed
        self._inserted += count
        self._newest = count

    def settle(self) -> None:
        """Treat all views as equally old, once no more views are collected."""
        self._newest = len(self)

    def draw(self, batch_size: int, rng: np.random.Generator) -> Views:
        """Draw a batch of views, older ones first.

        Raises:
            UserError: if the buffer holds too few views for a batch without repetition.
        """
        older, newest = len(self) - self._newest, self._newest
        from_older = round(self.aggregation_factor * batch_size) if older else 0
        from_newest = batch_size - from_older
        if from_older > older or from_newest > newest:
            raise UserError(
                f"batch_size: got {batch_size} ({from_older} older views and {from_newest} of the newest collection), "
                f"expected at most the {older} and {newest} views in the buffer; lower data.batch_size or raise "
                "callbacks.replay_buffer.prefill_steps or callbacks.replay_buffer.update_interval"
            )
        first = self._inserted - len(self)
        picks = np.concatenate(
            [
                first + rng.choice(older, from_older, replace=False) if from_older else np.empty(0, np.int64),
                first + older + rng.choice(newest, from_newest, replace=False),
            ]
        )
        rows = picks % self.size
        return {name: _unpack(store[rows], self._shapes[name]) for name, store in self._store.items()}


def _pack(values: np.ndarray) -> np.ndarray:
    if values.dtype != bool:
        return values
    return np.packbits(values.reshape(len(values), -1), axis=1)


def _unpack(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if not shape:
        return values
    bits = np.unpackbits(values, axis=1, count=int(np.prod(shape)))
    return bits.view(bool).reshape(len(values), *shape)
