"""Conversion of decoded ROS messages to arrays: images, camera_info and poses.

ROS 1 and ROS 2 bags, Zenoh and rclpy all decode to objects with the fields of the message definitions.
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
"""Number of channels and conversion to RGB of each encoding (sensor_msgs/image_encodings.hpp)."""

DEPTHS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}

MILLIMETRES = 1000.0
"""Units per metre of 16-bit depth (REP 118)."""

T = TypeVar("T")


def stamp_of(message: Any) -> Stamp:
    """Return the time stamp of a message with a header.

    Raises:
        BrokenRecordingError: if the time stamp is invalid.
    """
    stamp = message.header.stamp
    if not 0 <= stamp.nanosec < SECOND:
        raise BrokenRecordingError(f"stamp: got {stamp.nanosec} nanoseconds, expected 0 to {SECOND - 1}")
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def colour_of(message: Any) -> UInt8[np.ndarray, "h w 3"]:
    """Decode the colour of an Image or a CompressedImage.

    Raises:
        BrokenRecordingError: if the data do not fit the size, or the encoding is unknown.
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
    """Decode the depth, metres, of an Image or a CompressedImage, including compressedDepth.

    Args:
        message: Image or CompressedImage.
        scale: units per metre of 16-bit depth; floats are metres.

    Raises:
        BrokenRecordingError: if the data do not fit the size, or the encoding is unknown.
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
    """Return the intrinsics of a CameraInfo, whose fields have upper-case names in ROS 1.

    Args:
        message: CameraInfo.
        rectified: whether images are rectified: matrix P and no distortion (sensor_msgs/CameraInfo).

    Raises:
        UserError: if the intrinsics are invalid (as of an uncalibrated camera) or the model is not a pinhole.
    """
    size = int(message.width), int(message.height)
    p = [float(number) for number in (message.p if hasattr(message, "p") else message.P)]
    if rectified and p[0]:  # some drivers leave P empty
        return Intrinsics(*size, p[0], p[5], p[2], p[6])
    if message.distortion_model not in ("", "plumb_bob", "rational_polynomial"):
        raise UserError(
            f"camera_info: got distortion_model {message.distortion_model!r}, expected plumb_bob or "
            "rational_polynomial; rectify the images first and set rectified=true"
        )
    k = [float(number) for number in (message.k if hasattr(message, "k") else message.K)]
    d = tuple(float(number) for number in (message.d if hasattr(message, "d") else message.D))
    return Intrinsics(*size, k[0], k[4], k[2], k[5], d if any(d) else ())


def is_rectified(topic: str, setting: bool | None) -> bool:
    """Return whether a topic's images are rectified: `setting`, or if None, by the topic name of image_proc."""
    return "image_rect" in topic if setting is None else setting


def transform_of(transform: Any) -> Float64[np.ndarray, "4 4"]:
    """Convert a geometry_msgs/Transform or /Pose to a matrix.

    Raises:
        UserError: if the transform is invalid.
    """
    place = transform.translation if hasattr(transform, "translation") else transform.position
    turn = transform.rotation if hasattr(transform, "rotation") else transform.orientation
    return matrix_of((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


def _pixels(message: Any, dtype: np.dtype[Any], channels: int) -> np.ndarray:
    """Return the data of an Image as an array (rows, columns, channels)."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    row = width * channels * dtype.itemsize
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and step >= row and data.size == step * height):
        raise BrokenRecordingError(
            f"Image: got {data.size} bytes for {width} x {height} pixels of {message.encoding} with step {step}, "
            f"expected step x height bytes, a step of at least {row} and at most {MAX_SIDE} pixels per side"
        )
    pixels = data.reshape(height, step)[:, :row].copy().view(dtype).reshape(height, width, channels)
    return pixels.byteswap() if message.is_bigendian != (sys.byteorder == "big") else pixels


class Pairing(Generic[T]):
    """Pairs streamed colour and depth messages that are mutually nearest in time.

    A pair with different time stamps is held back until no nearer message can arrive.

    Args:
        tolerance: largest time difference of a pair, seconds.
        max_waiting: largest number of waiting messages of each kind.
    """

    def __init__(self, tolerance: float, max_waiting: int = 30) -> None:
        self.tolerance, self.max_waiting = round(tolerance * SECOND), max_waiting
        self.horizon = self.tolerance + round(JUMP * SECOND)
        self._dropped = 0
        self._waiting: dict[str, list[tuple[Stamp, T]]] = {"colour": [], "depth": []}  # in order of time
        self._newest: dict[str, float] = {"colour": -inf, "depth": -inf}

    @property
    def unpaired(self) -> int:
        """Number of messages without a partner."""
        return self._dropped + sum(map(len, self._waiting.values()))

    def add(self, kind: str, stamp: Stamp, item: T) -> list[tuple[Stamp, T, T]]:
        """Add a message of the kind `colour` or `depth`; return the pairs now complete, as (stamp, colour, depth)."""
        pairs = self.flush() if self._clock_jumped(stamp) else []
        insort(self._waiting[kind], (stamp, item), key=itemgetter(0))
        self._newest[kind] = stamp
        pairs += self._pairs()
        if len(self._waiting[kind]) > self.max_waiting:
            self._waiting[kind].pop(0)
            self._dropped += 1
        return pairs

    def flush(self) -> list[tuple[Stamp, T, T]]:
        """Return the remaining pairs at the end of the stream."""
        self._newest = {"colour": inf, "depth": inf}
        pairs = list(self._pairs())
        self._newest = {"colour": -inf, "depth": -inf}
        return pairs

    def _clock_jumped(self, stamp: Stamp) -> bool:
        """Return whether a time stamp is too far from earlier ones to pair (clock reset or outlier)."""
        waiting = [entry[0] for entries in self._waiting.values() for entry in entries]
        known = [time for time in self._newest.values() if time != -inf]
        return any(abs(time - stamp) > self.horizon for time in (*waiting, *known))

    def _pairs(self) -> Iterator[tuple[Stamp, T, T]]:
        while any(self._waiting.values()):
            first, other = sorted(self._waiting, key=self._next)
            # the oldest message of the other kind is nearest to the oldest message
            stamp, partner = self._next(first), self._next(other)
            if partner == inf and self._newest[other] <= stamp + self.tolerance:
                return
            apart, later = partner - stamp, self._next(first, 1)
            if apart > self.tolerance or abs(later - partner) < apart:
                self._waiting[first].pop(0)
                self._dropped += 1
            elif apart and later == inf and self._newest[first] < partner + apart:
                return
            else:
                (time, colour), (_, depth) = (self._waiting[kind].pop(0) for kind in ("colour", "depth"))
                yield time, colour, depth

    def _next(self, kind: str, index: int = 0) -> float:
        """Return the time stamp of a waiting message; infinity if it does not exist."""
        waiting = self._waiting[kind]
        return waiting[index][0] if index < len(waiting) else inf
