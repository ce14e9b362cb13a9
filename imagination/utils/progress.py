"""Progress bars of long stages, on a terminal or as lines in a log."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

T = TypeVar("T")

log = logging.getLogger(__name__)

console = Console(stderr=True)
"""Where bars are drawn; messages written through it appear above them."""

QUIET_SECONDS = 10.0
"""Without a terminal, a line is written this often."""


def progress(items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Iterate over `items` and show how far it is.

    Args:
        items: what to iterate over.
        description: of the stage, e.g. "rendering views".
        total: number of items, where `items` has no length.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    with bar(description, total) as advance:
        for item in items:
            yield item
            advance()


@contextmanager
def bar(description: str, total: int | None) -> Iterator[Callable[[], None]]:
    """Show a stage of `total` parts: a bar on a terminal, else a line every ten seconds and one at the end.

    The function it gives is called after each part.
    """
    if not console.is_terminal:
        with _lines(description, total) as advance:
            yield advance
        return
    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task(description, total=total)
        yield lambda: bars.advance(task)


@contextmanager
def _lines(description: str, total: int | None) -> Iterator[Callable[[], None]]:
    start = told = time.monotonic()
    done = 0

    def advance() -> None:
        nonlocal done, told
        done += 1
        now = time.monotonic()
        if now - told >= QUIET_SECONDS:
            told = now
            log.info("%s: %d of %s, %.0f s", description, done, total or "?", now - start)

    yield advance
    log.info("%s: %d done in %.1f s", description, done, time.monotonic() - start)
