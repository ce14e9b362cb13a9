"""What every recording gives: images with the camera's pose, one after the other, and a count of what was left out."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from imagination.geometry.rgbd import RgbdCamera
from imagination.recordings.pose_filters import Jumps, Order
from imagination.recordings.trajectory import Stamp
from imagination.utils.errors import UserError


class Images(NamedTuple):
    """What a camera took at one time.

    Attributes:
        rgb: colour.
        depth: metres along the optical axis, 0 where nothing returned.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "k l"]


class Shot(NamedTuple):
    """One entry of a recording.

    Attributes:
        stamp: its time.
        camera_to_world: of the colour camera's optical frame; None if there is no pose at that time.
        load: reads the images.
    """

    stamp: Stamp
    camera_to_world: Float64[np.ndarray, "4 4"] | None
    load: Callable[[], Images]


class Frame(NamedTuple):
    """An entry that can be mapped: see `Shot` and `Images`."""

    stamp: Stamp
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "k l"]
    camera_to_world: Float64[np.ndarray, "4 4"]


class BrokenRecordingError(UserError):
    """A recording that cannot be read any further; what came before is sound."""


@runtime_checkable
class Recording(Protocol):
    """A recording on disk.

    Attributes:
        camera: that took the images.
        world: id of the frame that the poses are in.
        skipped: how many entries the recording itself left out, by the reason.
    """

    camera: RgbdCamera
    world: str
    skipped: Counter[str]

    def shots(self) -> Iterator[Shot]:
        """Its entries, in the order of the recording.

        Raises:
            BrokenRecordingError: where it is damaged, with the place.
        """


@dataclass
class Frames:
    """The frames of a recording that can be mapped, in order of time; the others are counted.

    Attributes:
        recording: they come from.
        max_speed: metres a second at which the camera may move; None: any. See `Jumps`.
        mapped: frames given and worked up so far.
    """

    recording: Recording
    max_speed: float | None = None
    mapped: int = 0
    _skipped: Counter[str] = field(default_factory=Counter)
    _refused: bool = False
    _jump: str = ""
    _holes: int = 0
    _pixels: int = 0

    @property
    def skipped(self) -> Counter[str]:
        """Entries left out, by the reason."""
        return self.recording.skipped + self._skipped

    def refuse(self, reason: str) -> None:
        """Count the frame that was given last as left out after all."""
        self._refused = True
        self._skipped[reason] += 1

    def __iter__(self) -> Iterator[Frame]:
        order, jumps = Order(), Jumps(self.max_speed)
        for shot in self.recording.shots():
            if shot.camera_to_world is None:
                self._skipped["no pose at its time"] += 1
            elif fault := order.fault(shot.stamp):
                self._skipped[fault] += 1
            else:
                try:
                    jumps.check(shot.stamp, shot.camera_to_world)
                except UserError as error:
                    self._skipped["jump of the pose"] += 1
                    self._jump = self._jump or str(error)
                    continue
                images = shot.load()
                self._refused = False
                self._holes += images.depth.size - int(np.count_nonzero(images.depth))
                self._pixels += images.depth.size
                yield Frame(shot.stamp, *images, shot.camera_to_world)
                self.mapped += not self._refused  # only now: it may have been interrupted

    def summary(self) -> str:
        """How many frames were mapped, what share of their depth is missing, and why others were not."""
        lines = [f"{self.mapped} frames mapped, {self.skipped.total()} skipped"]
        if self._pixels:
            lines.append(f"    {self._holes / self._pixels:.1%} of their depth pixels are holes")
        lines += [f"    {count} x {reason}" for reason, count in self.skipped.most_common()]
        if self._jump:
            lines.append(f"    the first jump: {self._jump}")
        return "\n".join(lines)
