"""Prefetching of items by threads."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")


def prefetch(make: Callable[[int], Item], count: int, threads: int) -> Iterator[Item]:
    """Yield make(0), …, make(count - 1) in order, computed up to `threads` items ahead.

    An exception of `make` is raised when its item is due. Closing the iterator waits for the items in progress.

    Args:
        make: function of an item's number alone, called in several threads at once.
        count: number of items.
        threads: number of threads; 0 computes each item in the calling thread when it is requested.
    """
    if threads == 0:
        yield from map(make, range(count))
        return
    with ThreadPoolExecutor(threads) as pool:
        pending = deque(pool.submit(make, number) for number in range(min(threads, count)))
        for number in range(threads, threads + count):
            item = pending.popleft().result()
            if number < count:
                pending.append(pool.submit(make, number))
            yield item
