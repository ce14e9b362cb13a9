"""Progress of long stages, as bars on a terminal or as lines in a log."""

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
"""Console of the progress bars; messages written to it appear above them."""

QUIET_SECONDS = 10.0
"""Interval between lines without a terminal, seconds."""


def progress(items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Iterate over `items` and show the progress.

    Args:
        items: items of the stage.
        description: name of the stage, e.g. "rendering views".
        total: number of items, if `items` has no length.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    with bar(description, total) as advance:
        for item in items:
            yield item
            advance()


@contextmanager
def bar(description: str, total: int | None) -> Iterator[Callable[[], None]]:
    """Show the progress of a stage of `total` steps: as a bar on a terminal, otherwise as lines in the log.

    Yields:
        function to call after each step.
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
    start = logged = time.monotonic()
    done = 0

    def advance() -> None:
        nonlocal done, logged
        done += 1
        now = time.monotonic()
        if now - logged >= QUIET_SECONDS:
            logged = now
            log.info("%s: %d of %s, %.0f s", description, done, total or "?", now - start)

    yield advance
    log.info("%s: %d done in %.1f s", description, done, time.monotonic() - start)
