"""Poses over time, and frames that move against each other: a transform at any time, by interpolation."""

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64

from imagination.errors import UserError, check_range

Stamp = int
"""Nanoseconds."""

SECOND = 1_000_000_000
"""Nanoseconds."""

SLACK = 0.5
"""Metres by which poses may differ at any speed: a loop was closed."""

MOST_FRAMES = 10_000
"""In a tree of frames: trackers name new ones for ever."""

JUMP = 2.0
"""Seconds by which live messages may be late, or their clock pause; beyond, it was set anew."""


def matrix_of(position: Iterable[float], quaternion: Iterable[float]) -> Float64[np.ndarray, "4 4"]:
    """Transform from a position, metres, and a quaternion (x, y, z, w), which is normalised.

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
    one: Float64[np.ndarray, "4 4"], other: Float64[np.ndarray, "4 4"], share: float
) -> Float64[np.ndarray, "4 4"]:
    """Between two rigid transforms: the position on the line, the rotation about the one axis that joins them."""
    if share in (0.0, 1.0):
        return other if share else one
    turn = one[:3, :3].T @ other[:3, :3]
    angle = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    result: np.ndarray = one + share * (other - one)
    result[:3, :3] = one[:3, :3] @ _about(turn, angle, share)
    return result


def _about(turn: Float64[np.ndarray, "3 3"], angle: float, share: float) -> Float64[np.ndarray, "3 3"]:
    """A share of a rotation (Rodrigues' formula)."""
    if angle < 1e-12:
        return np.eye(3)
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    if np.linalg.norm(axis) < 1e-9:  # half a turn: the axis is what the rotation keeps
        axis = np.linalg.svd(turn - np.eye(3))[2][-1]
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    part = share * angle
    rotation: np.ndarray = np.eye(3) + np.sin(part) * cross + (1 - np.cos(part)) * cross @ cross
    return rotation


class Trajectory:
    """Transforms by time.

    Args:
        max_gap: seconds between two of them over which none is interpolated.
        keep: seconds of the past that are kept, of live transforms; all, whenever they were, if None.

    Attributes:
        repeated: entries of a time that was there already, left out. Late ones are sorted in.
    """

    def __init__(self, max_gap: float, keep: float | None = None) -> None:
        self.max_gap, self.keep = round(max_gap * SECOND), None if keep is None else round(keep * SECOND)
        self.repeated = 0
        self._jump = max(round(JUMP * SECOND), self.max_gap)
        self._stray: tuple[Stamp, Float64[np.ndarray, "4 4"]] | None = None
        self._stamps: deque[Stamp] = deque()
        self._matrices: deque[Float64[np.ndarray, "4 4"]] = deque()

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp: Stamp, matrix: Float64[np.ndarray, "4 4"]) -> None:
        """Add a transform, usually the newest.

        Raises:
            UserError: if it is live and its time is far from the newest one's. A second one beside it is believed,
                and the history begins anew with the two: the clock was reset, or a bag is played again.
        """
        if self.keep is not None and self._stamps and abs(stamp - self._stamps[-1]) > self._jump:
            self._begin_anew(stamp, matrix)
        self._stray = None
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

    def _begin_anew(self, stamp: Stamp, matrix: Float64[np.ndarray, "4 4"]) -> None:
        before, self._stray = self._stray, (stamp, matrix)
        if before is None or abs(stamp - before[0]) > self._jump:
            raise UserError(
                f"pose: got the time {stamp / SECOND:.3f} s, expected one at most {self._jump / SECOND:.1f} s from the "
                f"newest, {self._stamps[-1] / SECOND:.3f} s; check the clocks"
            )
        self._stamps, self._matrices = deque(), deque()
        self.add(*before)

    def at(self, stamp: Stamp) -> Float64[np.ndarray, "4 4"] | None:
        """The transform at a time; None before the first, after the last and in a gap."""
        after = bisect_left(self._stamps, stamp)
        if after == len(self._stamps):
            return None
        if self._stamps[after] == stamp:
            return self._matrices[after]
        if after == 0 or self._stamps[after] - self._stamps[after - 1] > self.max_gap:
            return None
        begin, end = self._stamps[after - 1], self._stamps[after]
        return interpolate(self._matrices[after - 1], self._matrices[after], (stamp - begin) / (end - begin))


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


class Transforms:
    """A tree of frames, as ROS' tf: each knows where it is in its parent, at any time.

    Args:
        max_gap: seconds over which a moving frame is not interpolated.
        keep: seconds of the past that are kept; all if None.
    """

    def __init__(self, max_gap: float, keep: float | None = None) -> None:
        self.max_gap, self.keep = max_gap, keep
        self._parents: dict[str, str] = {}
        self._fixed: dict[str, Float64[np.ndarray, "4 4"]] = {}
        self._moving: dict[str, Trajectory] = {}

    @property
    def moving(self) -> list[Trajectory]:
        """Those of all moving frames."""
        return list(self._moving.values())

    def add(
        self, parent: str, child: str, stamp: Stamp, matrix: Float64[np.ndarray, "4 4"], fixed: bool
    ) -> None:
        """Say where `child` is in `parent` at a time, or, if `fixed`, at all times.

        Raises:
            UserError: if the child has another parent already, would be its own ancestor, there are too many frames,
                or a live time is far from the newest (see `Trajectory.add`).
        """
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if self._parents.get(child, parent) != parent:
            raise UserError(
                f"tf: frame {child!r} is in {self._parents[child]!r} and in {parent!r}, expected one parent; "
                "choose one source of poses"
            )
        if child == parent or child in self.ancestors(parent):
            raise UserError(f"tf: frame {child!r} is its own ancestor")
        if child not in self._parents and len(self._parents) == MOST_FRAMES:
            raise UserError(f"tf: got frame {child!r} beside {MOST_FRAMES} others, expected at most as many")
        self._parents[child] = parent
        if fixed:
            self._fixed[child] = matrix
        else:
            self._moving.setdefault(child, Trajectory(self.max_gap, self.keep)).add(stamp, matrix)

    def moves(self, frames: Iterable[str]) -> bool:
        """Whether one of the frames moves in its parent."""
        return any(frame in self._moving for frame in frames)

    def ancestors(self, frame: str) -> list[str]:
        """A frame, its parent and so on."""
        chain = [frame.lstrip("/")]
        while chain[-1] in self._parents:
            chain.append(self._parents[chain[-1]])
        return chain

    def at(self, world: str, frame: str, stamp: Stamp) -> Float64[np.ndarray, "4 4"] | None:
        """Transform from `frame` to its ancestor `world`; None where one of those between has none at that time.

        Raises:
            UserError: if `world` is no ancestor of `frame`.
        """
        chain = self.ancestors(frame)
        world = world.lstrip("/")
        if world not in chain:
            raise UserError(
                f"tf: frame {frame!r} is not in {world!r}, its frames are {' in '.join(chain)}; expected one of these"
            )
        result = np.eye(4)
        for child in chain[: chain.index(world)]:
            step = self._fixed.get(child)
            if step is None:
                step = self._moving[child].at(stamp)
            if step is None:
                return None
            result = step @ result
        return result

    def between(self, frame: str, other: str) -> Float64[np.ndarray, "4 4"]:
        """Transform from one frame to another that it does not move against.

        Raises:
            UserError: if nothing joins them, or they move against each other.
        """
        ours, theirs = self.ancestors(frame), self.ancestors(other)
        common = [name for name in theirs if name in ours]
        if not common:
            raise UserError(
                f"tf: nothing joins {frame!r} and {other!r}; if they are depth and colour, use depth registered "
                "to colour (aligned_depth_to_color, depth_registered)"
            )
        chain = [*ours[: ours.index(common[0])], *theirs[: theirs.index(common[0])]]
        if self.moves(chain):
            raise UserError(f"tf: {frame!r} and {other!r} move against each other, expected fixed cameras")
        to_common, from_common = (self.at(common[0], name, 0) for name in (frame, other))
        assert to_common is not None and from_common is not None, "fixed at all times"
        result: np.ndarray = np.linalg.inv(from_common) @ to_common
        return result
