"""Registration rules: what becomes of a cell that was written before when a view has something to say about it.

A rule works on the values of the cells that one view touches, as flat arrays, and knows nothing of maps or windows. The
first write of a cell, and its first sighting, are taken whole whatever the rule, by the mapper. A new rule is any
callable of the same form.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int32

from imagination.utils.errors import check_range


@runtime_checkable
class UpdateRule(Protocol):
    """How old and new values become one."""

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        """Values of the cells after a view.

        Args:
            old: probabilities in the map.
            new: probabilities that the view gives.
            count: views that wrote each cell so far; where it is 0 the result is not used.
        """


@dataclass(frozen=True)
class MovingAverage:
    """m <- a m + (1 - a) v, the paper's rule and OccupancyAnticipation's.

    Attributes:
        aggregation_factor: a, weight of the old value, 0 to 1.
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
    """The moving average, of certain values only: a new value of high entropy leaves a written cell as it is.

    Attributes:
        aggregation_factor: weight of the old value, 0 to 1.
        max_entropy: in nats, of a value that is averaged in; ln 2 = 0.69 is that of probability 0.5.
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
    """The mean of all values so far: m <- m + (v - m) / (n + 1), n views having written the cell before."""

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        mean: np.ndarray = old + (new - old) / (count.astype(np.float32) + 1)
        return mean


@dataclass(frozen=True)
class Max:
    """The largest value so far; on masks, their union."""

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        largest: np.ndarray = np.maximum(old, new)
        return largest


@dataclass(frozen=True)
class Latest:
    """The latest value."""

    def __call__(
        self, old: Float32[np.ndarray, " n"], new: Float32[np.ndarray, " n"], count: Int32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        return new
