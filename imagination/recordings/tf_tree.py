"""Tree of coordinate frames (ROS tf) with transforms between them at any time."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64

from imagination.recordings.trajectory import Stamp, Trajectory
from imagination.utils.errors import UserError

MAX_FRAMES = 10_000
"""Largest number of frames in a tree; trackers keep adding new frames."""


class Transforms:
    """Tree of frames as in ROS' tf, with the transform of each frame to its parent over time.

    Args:
        max_gap: largest gap in the transforms of a moving frame that is interpolated, seconds.
        keep: history to keep, seconds; all if None.
    """

    def __init__(self, max_gap: float, keep: float | None = None) -> None:
        self.max_gap, self.keep = max_gap, keep
        self._parents: dict[str, str] = {}
        self._fixed: dict[str, Float64[np.ndarray, "4 4"]] = {}
        self._moving: dict[str, Trajectory] = {}

    @property
    def moving(self) -> list[Trajectory]:
        """Trajectories of all moving frames."""
        return list(self._moving.values())

    def add(
        self, parent: str, child: str, stamp: Stamp, matrix: Float64[np.ndarray, "4 4"], fixed: bool
    ) -> None:
        """Add the transform from `child` to `parent` at a time, or, if `fixed`, at all times.

        Raises:
            UserError: if the child has another parent, would be its own ancestor, there are too many frames, or a live
                time is far from the newest (see `Trajectory.add`).
        """
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if self._parents.get(child, parent) != parent:
            raise UserError(
                f"tf: frame {child!r} has the parents {self._parents[child]!r} and {parent!r}, expected one parent; "
                "use one source of poses"
            )
        if child == parent or child in self.ancestors(parent):
            raise UserError(f"tf: frame {child!r} is its own ancestor, expected a tree")
        if child not in self._parents and len(self._parents) == MAX_FRAMES:
            raise UserError(
                f"tf: got frame {child!r} in addition to {MAX_FRAMES} frames, expected at most {MAX_FRAMES}"
            )
        self._parents[child] = parent
        if fixed:
            self._fixed[child] = matrix
        else:
            self._moving.setdefault(child, Trajectory(self.max_gap, self.keep)).add(stamp, matrix)

    def moves(self, frames: Iterable[str]) -> bool:
        """Return whether one of the frames moves relative to its parent."""
        return any(frame in self._moving for frame in frames)

    def ancestors(self, frame: str) -> list[str]:
        """Return a frame and its ancestors, from the frame to the root."""
        chain = [frame.lstrip("/")]
        while chain[-1] in self._parents:
            chain.append(self._parents[chain[-1]])
        return chain

    def at(self, world: str, frame: str, stamp: Stamp) -> Float64[np.ndarray, "4 4"] | None:
        """Return the transform from `frame` to its ancestor `world`; None if a transform between them is missing.

        Raises:
            UserError: if `world` is no ancestor of `frame`.
        """
        chain = self.ancestors(frame)
        world = world.lstrip("/")
        if world not in chain:
            raise UserError(
                f"tf: frame {frame!r} has no ancestor {world!r}; expected one of {' in '.join(chain)}"
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
        """Return the fixed transform from one frame to another.

        Raises:
            UserError: if the frames have no common ancestor, or they move relative to each other.
        """
        ours, theirs = self.ancestors(frame), self.ancestors(other)
        common = [name for name in theirs if name in ours]
        if not common:
            raise UserError(
                f"tf: {frame!r} and {other!r} have no common ancestor; if they are depth and colour, use depth "
                "registered to colour (aligned_depth_to_color, depth_registered)"
            )
        chain = [*ours[: ours.index(common[0])], *theirs[: theirs.index(common[0])]]
        if self.moves(chain):
            raise UserError(
                f"tf: {frame!r} and {other!r} move relative to each other, expected fixed cameras"
            )
        to_common, from_common = (self.at(common[0], name, 0) for name in (frame, other))
        assert to_common is not None and from_common is not None, "fixed at all times"
        result: np.ndarray = np.linalg.inv(from_common) @ to_common
        return result
