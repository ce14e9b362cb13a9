"""Replay buffer: compact storage of the most recent views, from which batches are drawn."""

import numpy as np

from imagination.utils.errors import UserError, check_range
from imagination.views.collector import Views


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
