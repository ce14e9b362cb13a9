"""Collected training views: the replay buffer and the schedule of the collections that fill it."""

from collections.abc import Callable, Sequence
from functools import cached_property
from time import perf_counter
from typing import Protocol, runtime_checkable

import numpy as np

from imagination.data.replay_buffer import ReplayBuffer, ReplaySettings
from imagination.utils.process_group import world_size
from imagination.utils.progress import progress
from imagination.views.collector import Views


@runtime_checkable
class ViewCollector(Protocol):
    """Collector of training views, which renders them or reads them from shards."""

    @property
    def views_per_collection(self) -> int:
        """Number of views in a collection of this process."""

    def start(self, index: int) -> Callable[[], Views]:
        """Start collection `index` and return a function that waits for its views."""


class CollectedViews:
    """Views that this process has collected for its training, in a replay buffer.

    The views of an epoch depend only on the seed and the epoch, so that the epoch in a checkpoint suffices to resume.

    Args:
        settings: settings of the buffer and of the collections.
        make_collector: function that returns the collector of this process; called at the first collection.
        fields: names of the arrays of views that the buffer stores.
        lookahead: number of collections that are started in advance if several are due.

    Attributes:
        buffer: replay buffer of this process.
        seconds: duration of the last call of `collect`.
    """

    def __init__(
        self,
        settings: ReplaySettings,
        make_collector: Callable[[], ViewCollector],
        fields: Sequence[str],
        lookahead: int,
    ) -> None:
        self.settings, self.fields, self.lookahead = settings, fields, lookahead
        self._make_collector = make_collector
        self.buffer = self._empty_buffer()
        self.seconds = 0.0
        self._epoch = 0
        self._next = 0  # index of the next collection to insert
        self._started: dict[int, Callable[[], Views]] = {}  # functions that wait for collections, by index

    def collect(self, epoch: int, ahead: bool = False) -> None:
        """Insert the collections of all epochs up to `epoch`.

        Args:
            epoch: index of the epoch; an earlier one than before starts with an empty buffer.
            ahead: whether to start the collection of the next epoch, which the workers render during this epoch.
        """
        start = perf_counter()
        if epoch < self._epoch:
            self.buffer, self._next = self._empty_buffer(), 0
        self._epoch = epoch
        newest = self.settings.prefill_collections + epoch
        if self._holds_all:
            newest = min(newest, self._total - 1)
        self._insert_up_to(newest)
        if self._holds_all and epoch >= self.settings.collection_epochs:
            self.buffer.settle()
        elif ahead and not (self._holds_all and newest + 1 == self._total):
            self._start(newest + 1)
        self.seconds = perf_counter() - start

    @cached_property
    def collector(self) -> ViewCollector:
        """Collector of this process."""
        return self._make_collector()

    @property
    def count(self) -> int:
        """Number of distinct views collected so far, summed over all training processes."""
        return min(self._next, self._total) * self.collector.views_per_collection * world_size()

    @property
    def fill(self) -> float:
        """Fraction of the buffer that holds views."""
        return len(self.buffer) / self.buffer.size

    @property
    def mean_age(self) -> float:
        """Mean age of the views in the buffer: the number of collections that were inserted after a view."""
        return float((np.arange(len(self.buffer)) // self.collector.views_per_collection).mean())

    @property
    def _total(self) -> int:
        """Number of different collections."""
        return self.settings.prefill_collections + self.settings.collection_epochs

    @property
    def _holds_all(self) -> bool:
        """Whether the buffer is large enough for all collections."""
        return self._total * self.collector.views_per_collection <= self.buffer.size

    def _empty_buffer(self) -> ReplayBuffer:
        return ReplayBuffer(self.settings.size // world_size(), self.settings.aggregation_factor)

    def _insert_up_to(self, newest: int) -> None:
        """Insert the collections up to index `newest`, except those that later ones would overwrite."""
        capacity = -(-self.buffer.size // self.collector.views_per_collection)
        indices = range(max(self._next, newest + 1 - capacity), newest + 1)
        for index in progress(indices, "collecting views") if len(indices) > 1 else indices:
            for upcoming in range(index, min(index + self.lookahead, newest + 1)):
                self._start(upcoming)
            views = self._started.pop(index)()
            self.buffer.insert({name: views[name] for name in self.fields})
        self._next = newest + 1

    def _start(self, index: int) -> None:
        if index not in self._started:
            self._started[index] = self.collector.start(index % self._total)
