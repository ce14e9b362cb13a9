"""Wall time of the stages of a run."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class StageTimer:
    """Seconds spent in each named stage; the time of a nested stage does not count for the outer one."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Reset all times, for a run that is not the first of its process."""
        self.seconds: dict[str, float] = {}
        self._open: list[str] = []
        self._start = self._since = time.monotonic()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent in the context to the stage `name`."""
        self._update()
        self._open.append(name)
        try:
            yield
        finally:
            self._update()
            self._open.pop()

    def report(self) -> dict[str, float]:
        """Return the seconds of each stage, of everything else ("rest") and since the start of the run ("total")."""
        total = time.monotonic() - self._start
        return {**self.seconds, "rest": total - sum(self.seconds.values()), "total": total}

    def _update(self) -> None:
        now = time.monotonic()
        if self._open:
            self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._since
        self._since = now


stage_timer = StageTimer()
"""Timer of this process."""

stage = stage_timer.stage
