"""Filters of pose streams: order in time and implausible jumps."""

import numpy as np
from jaxtyping import Float64

from imagination.recordings.trajectory import JUMP, SECOND, SLACK, Stamp
from imagination.utils.errors import UserError

MAX_SPEED = 5.0
"""Largest plausible speed of the camera, m/s."""


class Order:
    """Detects repeated and late time stamps.

    A stamp that is behind the last one by more than `JUMP` is rejected; if the next stamp follows it, that one is
    accepted, because the earlier time was an outlier or the clock was reset.
    """

    def __init__(self) -> None:
        self._last: Stamp | None = None
        self._behind: Stamp | None = None

    def fault(self, stamp: Stamp) -> str:
        """Check the next time stamp; return the reason to skip it, or an empty string."""
        if self._last is not None and stamp <= self._last:
            behind, self._behind = self._behind, stamp if self._last - stamp > JUMP * SECOND else None
            if stamp == self._last:
                return "repeated time stamp"
            if behind is None or self._behind is None or stamp <= behind:
                return "time stamp out of order"
        self._last, self._behind = stamp, None
        return ""


Place = tuple[Stamp, Float64[np.ndarray, " 3"]]
"""Time stamp and position (x, y, z), metres."""


class Jumps:
    """Detects implausible poses, as of lost odometry or an outlier.

    A pose that is farther from the last one than `SLACK` and `MAX_SPEED` allow is rejected. A later pose that is
    reachable from the rejected one is accepted, because the robot was relocalised.
    """

    def __init__(self) -> None:
        self._last: Place | None = None
        self._rejected: Place | None = None

    def check(self, stamp: Stamp, pose: Float64[np.ndarray, "4 4"]) -> None:
        """Check the next pose.

        Raises:
            UserError: if the pose is implausible.
        """
        place = stamp, pose[:3, 3]
        if self._last is None:
            self._last = place
            return
        last = self._last
        distances = [_distance(one, place) for one in (last, self._rejected) if one is not None]
        if all(metres > SLACK + MAX_SPEED * seconds for metres, seconds in distances):
            self._rejected = place
            (x, y, z), (u, v, w) = last[1].tolist(), place[1].tolist()
            raise UserError(
                f"pose: got ({u:.2f}, {v:.2f}, {w:.2f}) m {distances[0][1]:.2f} s after ({x:.2f}, {y:.2f}, {z:.2f}), "
                f"expected a speed of at most {MAX_SPEED} m/s; check the odometry and the time stamps"
            )
        self._last, self._rejected = place, None


def _distance(one: Place, other: Place) -> tuple[float, float]:
    """Return the distance between two poses in metres and in seconds."""
    return float(np.linalg.norm(other[1] - one[1])), abs(other[0] - one[0]) / SECOND
