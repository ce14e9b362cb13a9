"""Filters of pose streams: order in time and implausible jumps."""

import numpy as np
from jaxtyping import Float64

from imagination.recordings.trajectory import JUMP, SECOND, SLACK, Stamp
from imagination.utils.errors import UserError, check_range


class Order:
    """Tells frames that come again or too late.

    One that is far behind, by more than `JUMP`, is not believed; the next one, if it is later, is: the time before was
    stray, or the clock was set anew.
    """

    def __init__(self) -> None:
        self._last: Stamp | None = None
        self._behind: Stamp | None = None

    def fault(self, stamp: Stamp) -> str:
        """Take the next time in; what is wrong with it, nothing if it is in order."""
        if self._last is not None and stamp <= self._last:
            behind, self._behind = self._behind, stamp if self._last - stamp > JUMP * SECOND else None
            if stamp == self._last:
                return "repeated time stamp"
            if behind is None or self._behind is None or stamp <= behind:
                return "time stamp out of order"
        self._last, self._behind = stamp, None
        return ""


Place = tuple[Stamp, Float64[np.ndarray, " 3"]]
"""When, and where."""


class Jumps:
    """Tells poses that no robot has reached: of lost odometry, of a stray reading.

    The first beyond a jump is not believed; one that can be reached from there is: the robot was relocalised.

    Args:
        max_speed: metres a second; None believes every pose.

    Raises:
        UserError: if it is out of range.
    """

    def __init__(self, max_speed: float | None) -> None:
        self.max_speed = (
            None if max_speed is None else check_range("max_speed", max_speed, 0.0, 1e4, "m/s", open_low=True)
        )
        self._last: Place | None = None
        self._stray: Place | None = None

    def check(self, stamp: Stamp, pose: Float64[np.ndarray, "4 4"]) -> None:
        """Take the next pose in.

        Raises:
            UserError: if it is not to be believed.
        """
        here = stamp, pose[:3, 3]
        if self._last is None or self.max_speed is None:
            self._last = here
            return
        before = self._last
        reached = [_apart(one, here) for one in (before, self._stray) if one is not None]
        if all(metres > SLACK + self.max_speed * seconds for metres, seconds in reached):
            self._stray = here
            (x, y, z), (u, v, w) = before[1].tolist(), here[1].tolist()
            raise UserError(
                f"pose: got ({u:.2f}, {v:.2f}, {w:.2f}) m {reached[0][1]:.2f} s after ({x:.2f}, {y:.2f}, {z:.2f}), "
                f"expected at most {self.max_speed} m/s; if the robot was there, raise max_speed (null: any)"
            )
        self._last, self._stray = here, None


def _apart(one: Place, other: Place) -> tuple[float, float]:
    """Metres and seconds between two poses."""
    return float(np.linalg.norm(other[1] - one[1])), abs(other[0] - one[0]) / SECOND
