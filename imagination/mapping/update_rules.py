"""Update rules: how a view's evidence changes map cells that were written before.

A rule works on flat arrays of the cells that one view writes and is independent of maps and windows. The mapper sets
the value of a cell at its first write and at its first observation without the rule. Any callable of the same signature
is a rule.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int32

from imagination.utils.errors import check_range


@runtime_checkable
class UpdateRule(Protocol):
    """Combines old and new cell values."""

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        """Return the values of the cells after a view.

        Args:
            old: probabilities in the map.
            new: probabilities of the view.
            count: number of views that wrote each cell so far; where it is 0 the result is not used.
        """


@dataclass(frozen=True)
class MovingAverage:
    """Moving average m <- a m + (1 - a) v, as in the paper and in OccupancyAnticipation.

    Attributes:
        aggregation_factor: weight a of the old value, 0 to 1.
    """

    aggregation_factor: float = 0.9

    def __post_init__(self) -> None:
        check_range("aggregation_factor", self.aggregation_factor, 0.0, 1.0)

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        return self.aggregation_factor * old + (1 - self.aggregation_factor) * new


@dataclass(frozen=True)
class EntropyMovingAverage:
    """Moving average that ignores new values of high entropy.

    Attributes:
        aggregation_factor: weight of the old value, 0 to 1.
        max_entropy: largest entropy of a value that is averaged in, nats; ln 2 = 0.69 is that of probability 0.5.
    """

    aggregation_factor: float = 0.9
    max_entropy: float = 0.5

    def __post_init__(self) -> None:
        check_range("aggregation_factor", self.aggregation_factor, 0.0, 1.0)
        check_range("max_entropy", self.max_entropy, 0.0, float(np.log(2)), "nats")

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        tiny = np.finfo(np.float32).tiny  # 0 log 0 is 0
        entropy = -new * np.log(np.maximum(new, tiny)) - (1 - new) * np.log(np.maximum(1 - new, tiny))
        average = self.aggregation_factor * old + (1 - self.aggregation_factor) * new
        return np.where(entropy <= self.max_entropy, average, old)


@dataclass(frozen=True)
class Mean:
    """Mean of all values so far: m <- m + (v - m) / (n + 1), where n views have written the cell before."""

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        mean: np.ndarray = old + (new - old) / (count.astype(np.float32) + 1)
        return mean


@dataclass(frozen=True)
class Max:
    """Largest value so far; the union of masks."""

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        largest: np.ndarray = np.maximum(old, new)
        return largest


@dataclass(frozen=True)
class Latest:
    """Latest value."""

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        return new
