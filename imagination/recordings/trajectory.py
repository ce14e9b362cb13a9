"""Trajectories: poses over time and their interpolation."""

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64

from imagination.utils.errors import UserError

Stamp = int
"""Time stamp, nanoseconds."""

SECOND = 1_000_000_000
"""One second, nanoseconds."""

SLACK = 0.5
"""Distance that poses may jump at any speed, as at a loop closure, metres."""

JUMP = 2.0
"""Largest delay of live messages or pause of their clock, seconds; a larger difference is a clock reset."""


def matrix_of(position: Iterable[float], quaternion: Iterable[float]) -> Float64[np.ndarray, "4 4"]:
    """Return the transform of a position, metres, and a quaternion (x, y, z, w), which is normalised.

    Raises:
        UserError: if a number is not finite, or the quaternion is nearly 0.
    """
    place, turn = np.array(list(position), np.float64), np.array(list(quaternion), np.float64)
    length = np.linalg.norm(turn)
    if not (np.isfinite(place).all() and 0.5 < length < 2):  # NaN compares false
        raise UserError(
            f"pose: got {place.tolist()} and {turn.tolist()}, expected metres and a unit quaternion"
        )
    x, y, z, w = (turn / length).tolist()
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = place
    return matrix


def interpolate(
    one: Float64[np.ndarray, "4 4"], other: Float64[np.ndarray, "4 4"], fraction: float
) -> Float64[np.ndarray, "4 4"]:
    """Interpolate rigid transforms: position linearly, rotation at constant speed about one axis (slerp)."""
    if fraction in (0.0, 1.0):
        return other if fraction else one
    turn = one[:3, :3].T @ other[:3, :3]
    angle = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    result: np.ndarray = one + fraction * (other - one)
    result[:3, :3] = one[:3, :3] @ _partial_rotation(turn, angle, fraction)
    return result


def _partial_rotation(
    turn: Float64[np.ndarray, "3 3"], angle: float, fraction: float
) -> Float64[np.ndarray, "3 3"]:
    """Return a fraction of a rotation (Rodrigues' formula)."""
    if angle < 1e-12:
        return np.eye(3)
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    if np.linalg.norm(axis) < 1e-9:  # half a turn: the axis is the invariant direction
        axis = np.linalg.svd(turn - np.eye(3))[2][-1]
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    part = fraction * angle
    rotation: np.ndarray = np.eye(3) + np.sin(part) * cross + (1 - np.cos(part)) * cross @ cross
    return rotation


class Trajectory:
    """Transforms in order of time.

    Args:
        max_gap: largest gap between two transforms that is interpolated, seconds.
        keep: history of live transforms to keep, seconds; None for recordings, which keeps all.

    Attributes:
        repeated: number of entries that were skipped because their time stamp exists; late entries are inserted.
    """

    def __init__(self, max_gap: float, keep: float | None = None) -> None:
        self.max_gap, self.keep = round(max_gap * SECOND), None if keep is None else round(keep * SECOND)
        self.repeated = 0
        self._jump = max(round(JUMP * SECOND), self.max_gap)
        self._outlier: tuple[Stamp, Float64[np.ndarray, "4 4"]] | None = None
        self._stamps: deque[Stamp] = deque()
        self._matrices: deque[Float64[np.ndarray, "4 4"]] = deque()

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp: Stamp, matrix: Float64[np.ndarray, "4 4"]) -> None:
        """Add a transform, usually the newest.

        Raises:
            UserError: if a live transform's time is far from the newest time. If a second transform confirms that time,
                the history restarts with these two: the clock was reset, or a bag is played again.
        """
        if self.keep is not None and self._stamps and abs(stamp - self._stamps[-1]) > self._jump:
            self._restart(stamp, matrix)
        self._outlier = None
        index = len(self._stamps)
        while index and self._stamps[index - 1] > stamp:
            index -= 1
        if index and self._stamps[index - 1] == stamp:
            self.repeated += 1
            return
        self._stamps.insert(index, stamp)
        self._matrices.insert(index, matrix)
        while self.keep is not None and self._stamps[-1] - self._stamps[0] > self.keep:
            self._stamps.popleft()
            self._matrices.popleft()

    def _restart(self, stamp: Stamp, matrix: Float64[np.ndarray, "4 4"]) -> None:
        """Restart the history if a previous outlier is close to `stamp`; otherwise raise a UserError."""
        previous, self._outlier = self._outlier, (stamp, matrix)
        if previous is None or abs(stamp - previous[0]) > self._jump:
            raise UserError(
                f"pose: got the time {stamp / SECOND:.3f} s, expected one at most {self._jump / SECOND:.1f} s from the "
                f"newest, {self._stamps[-1] / SECOND:.3f} s; check the clocks"
            )
        self._stamps, self._matrices = deque(), deque()
        self.add(*previous)

    def at(self, stamp: Stamp) -> Float64[np.ndarray, "4 4"] | None:
        """Return the transform at a time; None before the first, after the last and in a gap."""
        after = bisect_left(self._stamps, stamp)
        if after == len(self._stamps):
            return None
        if self._stamps[after] == stamp:
            return self._matrices[after]
        if after == 0 or self._stamps[after] - self._stamps[after - 1] > self.max_gap:
            return None
        begin, end = self._stamps[after - 1], self._stamps[after]
        return interpolate(self._matrices[after - 1], self._matrices[after], (stamp - begin) / (end - begin))
