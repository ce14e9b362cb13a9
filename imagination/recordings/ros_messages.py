"""ROS messages to arrays: images, camera_info, poses. Nothing here decodes bytes, so that ROS 1 and 2 bags, Zenoh and
rclpy share it: all give objects with the fields of the message definitions.
"""

import sys
from bisect import insort
from collections.abc import Iterator
from math import inf
from operator import itemgetter
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from imagination.geometry.rgbd import Intrinsics
from imagination.recordings.images import (
    MAX_SIDE,
    decode_colour,
    decode_compressed_depth,
    decode_depth,
    to_metres,
)
from imagination.recordings.recording import BrokenRecordingError
from imagination.recordings.trajectory import JUMP, SECOND, Stamp, matrix_of
from imagination.utils.errors import UserError

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, ODOMETRY = "sensor_msgs/msg/CameraInfo", "nav_msgs/msg/Odometry"
TRANSFORMS, OLD_TRANSFORMS = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"

COLOURS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
}
"""Channels of each encoding (sensor_msgs/image_encodings.hpp), and how they become RGB."""

DEPTHS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}

MILLIMETRES = 1000.0
"""Units a metre of 16-bit depth (REP 118)."""

T = TypeVar("T")


def stamp_of(message: Any) -> Stamp:
    """Time of a message with a header.

    Raises:
        BrokenRecordingError: if it is none.
    """
    stamp = message.header.stamp
    if not 0 <= stamp.nanosec < SECOND:
        raise BrokenRecordingError(f"stamp: got {stamp.nanosec} nanoseconds, expected 0 to {SECOND - 1}")
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def colour_of(message: Any) -> UInt8[np.ndarray, "h w 3"]:
    """Colour of an Image or a CompressedImage.

    Raises:
        BrokenRecordingError: if its data do not fit its size, or its encoding is unknown.
    """
    if hasattr(message, "format"):
        return decode_colour(bytes(message.data), "CompressedImage")
    if message.encoding not in COLOURS:
        raise BrokenRecordingError(
            f"Image: got encoding {message.encoding!r}, expected one of: {', '.join(COLOURS)}"
        )
    channels, conversion = COLOURS[message.encoding]
    pixels = _pixels(message, np.dtype(np.uint8), channels)
    return np.ascontiguousarray(pixels) if conversion is None else cv2.cvtColor(pixels, conversion)


def depth_of(message: Any, scale: float = MILLIMETRES) -> Float32[np.ndarray, "h w"]:
    """Depth in metres of an Image or a CompressedImage, compressedDepth included.

    Args:
        message: the image.
        scale: units a metre of 16-bit depth; floats are metres.

    Raises:
        BrokenRecordingError: if its data do not fit its size, or its encoding is unknown.
    """
    if not hasattr(message, "format"):
        if message.encoding not in DEPTHS:
            raise BrokenRecordingError(
                f"Image: got encoding {message.encoding!r}, expected one of: {', '.join(DEPTHS)}"
            )
        raw = _pixels(message, np.dtype(DEPTHS[message.encoding]), 1)[..., 0]
    elif "compressedDepth" in message.format:
        raw = decode_compressed_depth(bytes(message.data), message.format, "CompressedImage")
    else:
        raw = decode_depth(bytes(message.data), "CompressedImage")
    return to_metres(raw, 1.0 if np.issubdtype(raw.dtype, np.floating) else scale)


def intrinsics_of(message: Any, rectified: bool = False) -> Intrinsics:
    """Intrinsics in a CameraInfo; ROS 1 names its fields in capitals.

    Args:
        message: the CameraInfo.
        rectified: of rectified images, which have those of the matrix P and no distortion (sensor_msgs/CameraInfo).

    Raises:
        UserError: if they are none, as those of a camera that was never calibrated, or its model is not a pinhole.
    """
    size = int(message.width), int(message.height)
    p = [float(number) for number in (message.p if hasattr(message, "p") else message.P)]
    if rectified and p[0]:  # some drivers leave it empty
        return Intrinsics(*size, p[0], p[5], p[2], p[6])
    if message.distortion_model not in ("", "plumb_bob", "rational_polynomial"):
        raise UserError(
            f"camera_info: got distortion_model {message.distortion_model!r}, expected plumb_bob or "
            "rational_polynomial; rectify the images before, and say so (rectified=true)"
        )
    k = [float(number) for number in (message.k if hasattr(message, "k") else message.K)]
    d = tuple(float(number) for number in (message.d if hasattr(message, "d") else message.D))
    return Intrinsics(*size, k[0], k[4], k[2], k[5], d if any(d) else ())


def is_rectified(topic: str, said: bool | None) -> bool:
    """Whether a topic's images are rectified: as the user said, else by its name, as image_proc gives it."""
    return "image_rect" in topic if said is None else said


def transform_of(transform: Any) -> Float64[np.ndarray, "4 4"]:
    """A geometry_msgs/Transform or /Pose as a matrix.

    Raises:
        UserError: if it is none.
    """
    place = transform.translation if hasattr(transform, "translation") else transform.position
    turn = transform.rotation if hasattr(transform, "rotation") else transform.orientation
    return matrix_of((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


def _pixels(message: Any, dtype: np.dtype[Any], channels: int) -> np.ndarray:
    """The data of an Image as an array (rows, columns, channels)."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    row = width * channels * dtype.itemsize
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and step >= row and data.size == step * height):
        raise BrokenRecordingError(
            f"Image: got {data.size} bytes for {width} x {height} pixels of {message.encoding} in steps of {step}, "
            f"expected step x height, steps of at least {row} and at most {MAX_SIDE} pixels a side"
        )
    pixels = data.reshape(height, step)[:, :row].copy().view(dtype).reshape(height, width, channels)
    return pixels.byteswap() if message.is_bigendian != (sys.byteorder == "big") else pixels


class Pairing(Generic[T]):
    """Colour and depth that belong together, of messages that come one by one: each the nearest in time of the other.

    A pair of different times waits until nothing nearer can come.

    Args:
        tolerance: seconds between the two, at most.
        most: of each kind that wait for a partner.
    """

    def __init__(self, tolerance: float, most: int = 30) -> None:
        self.tolerance, self.most = round(tolerance * SECOND), most
        self.horizon = self.tolerance + round(JUMP * SECOND)
        self._given_up = 0
        self._waiting: dict[str, list[tuple[Stamp, T]]] = {"colour": [], "depth": []}  # in order of time
        self._newest: dict[str, float] = {"colour": -inf, "depth": -inf}

    @property
    def alone(self) -> int:
        """Messages that have found no partner."""
        return self._given_up + sum(map(len, self._waiting.values()))

    def add(self, kind: str, stamp: Stamp, item: T) -> list[tuple[Stamp, T, T]]:
        """Add a message of the kind `colour` or `depth`; the pairs that are clear now, as (stamp, colour, depth)."""
        found = self.rest() if self._set_anew(stamp) else []
        insort(self._waiting[kind], (stamp, item), key=itemgetter(0))
        self._newest[kind] = stamp
        found += self._pairs()
        if len(self._waiting[kind]) > self.most:
            self._waiting[kind].pop(0)
            self._given_up += 1
        return found

    def rest(self) -> list[tuple[Stamp, T, T]]:
        """The pairs that are left where no message comes any more."""
        self._newest = {"colour": inf, "depth": inf}
        found = list(self._pairs())
        self._newest = {"colour": -inf, "depth": -inf}
        return found

    def _set_anew(self, stamp: Stamp) -> bool:
        """Whether a time is so far from those before that they find no partner any more: a clock was set anew, or one
        of the times is stray."""
        waiting = [entry[0] for entries in self._waiting.values() for entry in entries]
        known = [time for time in self._newest.values() if time != -inf]
        return any(abs(time - stamp) > self.horizon for time in (*waiting, *known))

    def _pairs(self) -> Iterator[tuple[Stamp, T, T]]:
        while any(self._waiting.values()):
            first, other = sorted(self._waiting, key=self._next)
            # to the oldest, the other's oldest is nearest
            stamp, partner = self._next(first), self._next(other)
            if partner == inf and self._newest[other] <= stamp + self.tolerance:
                return
            apart, later = partner - stamp, self._next(first, 1)
            if apart > self.tolerance or abs(later - partner) < apart:
                self._waiting[first].pop(0)
                self._given_up += 1
            elif apart and later == inf and self._newest[first] < partner + apart:
                return
            else:
                (time, colour), (_, depth) = (self._waiting[kind].pop(0) for kind in ("colour", "depth"))
                yield time, colour, depth

    def _next(self, kind: str, index: int = 0) -> float:
        """Time of one that waits; infinity if there is none."""
        waiting = self._waiting[kind]
        return waiting[index][0] if index < len(waiting) else inf
