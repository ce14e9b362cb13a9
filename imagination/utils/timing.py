"""Wall time of the stages of a run."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Shares:
    """Seconds spent in each named stage; a stage inside another counts for itself alone."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Count anew, for a run that is not the first of its process."""
        self.seconds: dict[str, float] = {}
        self._open: list[str] = []
        self._began = self._since = time.monotonic()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time spent inside for the stage `name`."""
        self._settle()
        self._open.append(name)
        try:
            yield
        finally:
            self._settle()
            self._open.pop()

    def report(self) -> dict[str, float]:
        """Seconds of each stage, of everything else ("rest") and of all since the run began ("total")."""
        total = time.monotonic() - self._began
        return {**self.seconds, "rest": total - sum(self.seconds.values()), "total": total}

    def _settle(self) -> None:
        now = time.monotonic()
        if self._open:
            self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._since
        self._since = now


shares = Shares()
"""Of this process."""

stage = shares.stage
