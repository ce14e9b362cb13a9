"""Timing on a noisy machine: functions that are compared are called alternately, and medians are reported."""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median
from time import perf_counter

import numpy as np


@dataclass
class Figure:
    """One row of the results.

    Attributes:
        what: name of the measurement.
        value: median; None if it could not be measured, with the reason in the note.
        unit: unit of the value and the limit.
        limit: bound by the machine, or the value of another method.
        limit_is: description of the limit.
        target: target value, or None.
        at_most: whether smaller values are better.
        of_limit: whether the target is a fraction of the limit instead of a value.
        rival: whether the limit is another method for the same result instead of a bound.
        note: remark for the reader.
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
        """Fraction of the limit that is reached, or speed relative to the other method."""
        if not self.limit or not self.value:
            return None
        seconds = self.unit in ("s", "ms")
        return self.limit / self.value if seconds else self.value / self.limit

    @property
    def met(self) -> bool | None:
        """Whether the target is reached."""
        if self.target is None or self.value is None:
            return None
        result = self.ratio if self.of_limit else self.value
        assert result is not None
        return result <= self.target if self.at_most else result >= self.target


def unmeasured(what: str, reason: str) -> Figure:
    """Return the row of a measurement that this machine cannot make."""
    return Figure(what, None, "", note=f"not measured: {reason}")


def medians(
    functions: Mapping[str, Callable[[], object]], seconds: float = 3.0, min_calls: int = 5
) -> dict[str, float]:
    """Return the median time of a call of each function, seconds.

    After a warm-up call the functions are called alternately for `seconds`, so that other load affects all alike.
    """
    for function in functions.values():
        function()
    times: dict[str, list[float]] = {name: [] for name in functions}
    end = perf_counter() + seconds
    while perf_counter() < end or min(map(len, times.values())) < min_calls:
        for name, function in functions.items():
            start = perf_counter()
            function()
            times[name].append(perf_counter() - start)
    return {name: median(values) for name, values in times.items()}


def copying(*arrays: np.ndarray) -> Callable[[], None]:
    """Return a function that copies the arrays, the minimum cost of reading and writing them once."""
    pairs = [(array, np.empty_like(array)) for array in arrays]

    def copy() -> None:
        for source, target in pairs:
            np.copyto(target, source)

    return copy


def peak_memory(whose: int = resource.RUSAGE_SELF) -> float:
    """Return the peak memory of this process, GB, or with `RUSAGE_CHILDREN` of the largest child that has ended.

    On Linux the peak of a child begins at the memory of its parent, so children should be started first.
    """
    return resource.getrusage(whose).ru_maxrss / 1e6
