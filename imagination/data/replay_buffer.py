"""The replay buffer: the most recent views, stored compactly, and the batches drawn from them."""

import numpy as np

from imagination.utils.errors import UserError, check_range
from imagination.views.collector import Views


class ReplayBuffer:
    """A ring of views: rgb uint8, depth float16, masks as packed bits.

    Batches mix old and new as registration does: a share `aggregation_factor` of each comes from the aggregated past,
    the rest from the newest collection; no view comes twice in a batch. Without a past all come from the newest.

    Args:
        size: views that are kept; the oldest make room.
        aggregation_factor: 0 to 1.

    Raises:
        UserError: if either is out of range.
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
        """Add a collection, which becomes the newest; the oldest views make room.

        Raises:
            UserError: if the collection is larger than the buffer.
        """
        count = len(views["pose"])
        if count > self.size:
            raise UserError(
                f"buffer size: got {self.size} views, expected at least the {count} of one collection; "
                "raise scale.buffer_size or lower scale.parallel_scenes"
            )
        rows = np.arange(self._inserted, self._inserted + count) % self.size
        for name, values in views.items():
            packed = _pack(values)
            if name not in self._store:  # pages are only taken once they are written
                self._store[name] = np.zeros((self.size, *packed.shape[1:]), packed.dtype)
                self._shapes[name] = values.shape[1:] if values.dtype == bool else ()
            self._store[name][rows] = packed
        self._inserted += count
        self._newest = count

    def settle(self) -> None:
        """Make all views equally old: nothing more is collected, so none of them is newer than the others."""
        self._newest = len(self)

    def draw(self, batch_size: int, rng: np.random.Generator) -> Views:
        """Draw a batch of views, old ones first.

        Raises:
            UserError: if the buffer holds too few views for a batch without repetition.
        """
        past, newest = len(self) - self._newest, self._newest
        old = round(self.aggregation_factor * batch_size) if past else 0
        if old > past or batch_size - old > newest:
            raise UserError(
                f"batch_size: got {batch_size}, of which {old} views from the past and {batch_size - old} from "
                f"the newest collection, but the buffer holds {past} and {newest}; lower scale.batch_size or raise "
                "scale.prefill_steps or scale.update_interval"
            )
        first = self._inserted - len(self)
        picks = np.concatenate(
            [
                first + rng.choice(past, old, replace=False) if old else np.empty(0, np.int64),
                first + past + rng.choice(newest, batch_size - old, replace=False),
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
