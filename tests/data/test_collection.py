"""Collections: those that an epoch inserts into the replay buffer, and the state of the buffer."""

from collections.abc import Callable
from unittest.mock import Mock

import numpy as np
import pytest

from imagination.data.collection import CollectedViews
from imagination.data.replay_buffer import ReplaySettings
from imagination.utils.errors import UserError
from imagination.views.collector import Collector, Views


def collected(size: int, requested: list[int]) -> CollectedViews:
    """Two collections of ten views before the first epoch, then three; the indices of those waited for are kept."""

    def start(index: int) -> Callable[[], Views]:
        def wait() -> Views:
            requested.append(index)
            return {"pose": np.full((10, 3), float(index))}

        return wait

    settings = ReplaySettings(size, 5, 7, 0.5, 10, 3)
    collector = Mock(spec=Collector, views_per_collection=10, start=start)
    return CollectedViews(settings, lambda: collector, ["pose"], 2)


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        # the buffer holds all 5 collections of 10 views: nothing is collected after them
        (100, [[0, 1, 2], [3], [4], [], []]),
        # the buffer holds two collections: the collections are repeated in their order
        (20, [[1, 2], [3], [4], [0], [1]]),
    ],
)
def test_epochs_after_the_last_collection_reuse_the_views(size: int, expected: list[list[int]]) -> None:
    requested: list[int] = []
    views = collected(size, requested)
    counts = []
    for epoch, indices in enumerate(expected):
        requested.clear()
        views.collect(epoch, ahead=epoch < 4)
        assert requested == indices
        counts.append(views.count)
    assert counts == [30, 40, 50, 50, 50]
    resumed = collected(size, requested)
    resumed.collect(4)
    assert same_draws(views, resumed)


@pytest.mark.parametrize("size", [100, 20])
def test_an_earlier_epoch_starts_over(size: int) -> None:
    views, fresh = collected(size, []), collected(size, [])
    for epoch in (0, 1, 2, 3, 1):
        views.collect(epoch, ahead=True)
    fresh.collect(1)
    assert same_draws(views, fresh) and views.count == fresh.count == 40


def same_draws(one: CollectedViews, other: CollectedViews) -> bool:
    draws = [each.buffer.draw(4, np.random.default_rng(0))["pose"] for each in (one, other)]
    return np.array_equal(*draws)


def test_the_next_collection_is_started_ahead() -> None:
    views = collected(100, [])
    started = []
    collector = views.collector
    start = collector.start
    collector.start = lambda index: started.append(index) or start(index)
    views.collect(0, ahead=True)
    assert started == [0, 1, 2, 3]
    views.collect(1, ahead=True)
    views.collect(2, ahead=True)  # the last collection
    assert started == [0, 1, 2, 3, 4]


def test_fill_and_age() -> None:
    views = collected(40, [])
    views.collect(0)  # three collections, of age 2, 1 and 0
    assert (views.fill, views.mean_age) == (0.75, 1.0)
    views.collect(2)  # the first collection was overwritten
    assert (views.fill, views.mean_age) == (1.0, 1.5)
    assert views.seconds >= 0


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ((0, 5, 7, 0.5, 10, 3), "size"),
        ((20, 0, 7, 0.5, 10, 3), "update_interval"),
        ((20, 5, 0, 0.5, 10, 3), "update_batches"),
        ((20, 5, 7, 1.5, 10, 3), "aggregation_factor"),
        ((20, 5, 7, 0.5, 11, 3), "prefill_steps"),
        ((20, 5, 7, 0.5, -5, 3), "prefill_steps"),
        ((20, 5, 7, 0.5, 10, 0), "collection_epochs"),
    ],
)
def test_settings_out_of_range_are_refused(settings: tuple, key: str) -> None:
    with pytest.raises(UserError, match=f"callbacks.replay_buffer.{key}: got"):
        ReplaySettings(*settings)
