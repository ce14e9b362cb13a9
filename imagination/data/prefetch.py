"""Items made by threads while earlier ones are in use."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")


def ahead(make: Callable[[int], Item], count: int, threads: int) -> Iterator[Item]:
    """make(0), make(1), … up to `count` in their order, by as many threads, which are as many items ahead.

    What `make` raises is raised in that item's turn. Closing the iterator waits for the items that are being made.

    Args:
        make: an item; which one depends on the number alone, and several are made at once.
        count: of items.
        threads: 0 makes each item when it is asked for, in the thread that asks.
    """
    if threads == 0:
        yield from map(make, range(count))
        return
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque(pool.submit(make, number) for number in range(min(threads, count)))
        for number in range(threads, threads + count):
            item = waiting.popleft().result()
            if number < count:
                waiting.append(pool.submit(make, number))
            yield item
