"""Prefetching: the same items in the same order, and at most `threads` items ahead."""

import time
from itertools import islice

import numpy as np
import pytest

from imagination.data.prefetch import prefetch
from imagination.data.replay_buffer import ReplayBuffer


@pytest.mark.parametrize("threads", [0, 1, 3, 20])
def test_items_come_in_order(threads: int) -> None:
    def make(number: int) -> int:
        time.sleep(0.01 * (number % 3))  # finishes out of order
        return number * number

    assert list(prefetch(make, 7, threads)) == [0, 1, 4, 9, 16, 25, 36]
    assert list(prefetch(make, 0, threads)) == []


def test_at_most_threads_items_are_made_ahead() -> None:
    made: list[int] = []
    assert list(islice(prefetch(lambda number: made.append(number) or number, 100, 3), 2)) == [0, 1]
    assert len(made) == 5  # two in use, three ahead


def test_an_error_is_raised_when_its_item_is_due() -> None:
    items = prefetch(lambda number: 1 // (number - 1), 3, 2)
    assert next(items) == -1
    with pytest.raises(ZeroDivisionError):
        next(items)


def test_batches_drawn_ahead_are_those_drawn_in_turn() -> None:
    buffer = ReplayBuffer(200, 0.9)
    for number in range(10):
        buffer.insert({"pose": np.full((20, 3), number, np.float64) + np.arange(20)[:, None] / 100})

    def draw(number: int) -> list[float]:
        return buffer.draw(16, np.random.default_rng(number))["pose"][:, 0].tolist()

    assert list(prefetch(draw, 30, 4)) == list(prefetch(draw, 30, 0))
