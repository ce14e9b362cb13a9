"""Interface of recordings: a sequence of images with camera poses, and counts of skipped entries."""

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
    """Colour and depth images of one time.

    Attributes:
        rgb: colour image.
        depth: metres along the optical axis, 0 without a return.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "k l"]


class Shot(NamedTuple):
    """Entry of a recording.

    Attributes:
        stamp: time stamp.
        camera_to_world: transform of the colour camera's optical frame; None if there is no pose at that time.
        load: function that reads the images.
    """

    stamp: Stamp
    camera_to_world: Float64[np.ndarray, "4 4"] | None
    load: Callable[[], Images]


class Frame(NamedTuple):
    """Entry that can be mapped; see `Shot` and `Images`."""

    stamp: Stamp
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "k l"]
    camera_to_world: Float64[np.ndarray, "4 4"]


class BrokenRecordingError(UserError):
    """Damaged recording that cannot be read any further; the frames before the damage are valid."""


@runtime_checkable
class Recording(Protocol):
    """Recording on disk.

    Attributes:
        camera: camera of the images.
        world: id of the frame of the poses.
        skipped: number of entries that the recording skipped, by reason.
    """

    camera: RgbdCamera
    world: str
    skipped: Counter[str]

    def shots(self) -> Iterator[Shot]:
        """Iterate over the entries in the order of the recording.

        Raises:
            BrokenRecordingError: at the first damaged place, which the message names.
        """


@dataclass
class Frames:
    """Frames of a recording that can be mapped, in order of time; skipped entries are counted.

    Attributes:
        recording: recording of the frames.
        mapped: number of frames that were yielded and processed so far.
    """

    recording: Recording
    mapped: int = 0
    _skipped: Counter[str] = field(default_factory=Counter)
    _last_refused: bool = False
    _jump: str = ""
    _holes: int = 0
    _pixels: int = 0

    @property
    def skipped(self) -> Counter[str]:
        """Number of skipped entries by reason."""
        return self.recording.skipped + self._skipped

    def refuse(self, reason: str) -> None:
        """Count the last yielded frame as skipped."""
        self._last_refused = True
        self._skipped[reason] += 1

    def __iter__(self) -> Iterator[Frame]:
        order, jumps = Order(), Jumps()
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
                self._last_refused = False
                self._holes += images.depth.size - int(np.count_nonzero(images.depth))
                self._pixels += images.depth.size
                yield Frame(shot.stamp, *images, shot.camera_to_world)
                # after the yield, since mapping may have been interrupted
                self.mapped += not self._last_refused

    def summary(self) -> str:
        """Summarize the number of mapped frames, their fraction of depth holes and the reasons of skipped frames."""
        lines = [f"{self.mapped} frames mapped, {self.skipped.total()} skipped"]
        if self._pixels:
            lines.append(f"    {self._holes / self._pixels:.1%} of their depth pixels are holes")
        lines += [f"    {count} x {reason}" for reason, count in self.skipped.most_common()]
        if self._jump:
            lines.append(f"    the first jump: {self._jump}")
        return "\n".join(lines)
