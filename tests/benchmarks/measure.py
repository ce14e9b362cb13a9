"""Timing that survives a noisy machine: what is compared is measured in turns, and medians are told."""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median
from time import perf_counter

import numpy as np


@dataclass
class Figure:
    """One line of the results.

    Attributes:
        what: was measured.
        value, unit: the median; None where it could not be measured, and the note says why.
        limit: what the machine could do at best, or what a rival does, in the same unit.
        limit_is: what the limit is.
        target, at_most: what is wanted, and whether less is better; None if nothing is asked.
        of_limit: the target is a share of the limit, not a value.
        rival: the limit is another way to the same result, not a bound.
        note: anything a reader has to know.
    """

    what: str
    value: float | None
    unit: str
    limit: float | None = None
    limit_is: str = ""
    target: float | None = None
    at_most: bool = False
    of_limit: bool = False
    rival: bool = False
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """How near to the limit: 1 is there; beside a rival, how many times faster."""
        if not self.limit or not self.value:
            return None
        seconds = self.unit in ("s", "ms")
        return self.limit / self.value if seconds else self.value / self.limit

    @property
    def met(self) -> bool | None:
        """Whether the target is reached."""
        if self.target is None or self.value is None:
            return None
        got = self.ratio if self.of_limit else self.value
        assert got is not None
        return got <= self.target if self.at_most else got >= self.target


def unmeasured(what: str, why: str) -> Figure:
    """The line of something that this machine cannot measure."""
    return Figure(what, None, "", note=f"not measured: {why}")


def medians(
    functions: Mapping[str, Callable[[], object]], seconds: float = 3.0, least: int = 5
) -> dict[str, float]:
    """Median seconds of a call of each function, all called in turns for `seconds` after one call to warm up.

    In turns, so that whatever else the machine does falls on all alike.
    """
    for function in functions.values():
        function()
    times: dict[str, list[float]] = {name: [] for name in functions}
    end = perf_counter() + seconds
    while perf_counter() < end or min(map(len, times.values())) < least:
        for name, function in functions.items():
            start = perf_counter()
            function()
            times[name].append(perf_counter() - start)
    return {name: median(values) for name, values in times.items()}


def copying(*arrays: np.ndarray) -> Callable[[], None]:
    """Copies as many bytes as the arrays have: the least that reading and writing them once can take."""
    pairs = [(array, np.empty_like(array)) for array in arrays]

    def copy() -> None:
        for source, target in pairs:
            np.copyto(target, source)

    return copy


def peak_memory(whose: int = resource.RUSAGE_SELF) -> float:
    """Most memory that this process has held, GB; of `RUSAGE_CHILDREN`, the largest one that it started and that ended.

    To Linux a process begins as large as the one that starts it: those that measure others start them first.
    """
    return resource.getrusage(whose).ru_maxrss / 1e6
