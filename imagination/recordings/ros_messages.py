"""ROS messages to arrays: images, camera_info, poses. Nothing here decodes bytes, so that ROS 1 and 2 bags, Zenoh and
rclpy share it: all give objects with the fields of the message definitions.
"""

import sys
from collections import deque
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from imagination.errors import UserError
from imagination.geometry.rgbd import Intrinsics
from imagination.recordings.images import (
    MAX_SIDE,
    decode_colour,
    decode_compressed_depth,
    decode_depth,
    to_metres,
)
from imagination.recordings.recording import BrokenRecordingError, Stamp
from imagination.recordings.trajectory import SECOND, matrix_of

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


def intrinsics_of(message: Any) -> Intrinsics:
    """Intrinsics in a CameraInfo; ROS 1 names its fields in capitals.

    Raises:
        UserError: if they are none, as those of a camera that was never calibrated, or its model is not a pinhole.
    """
    if message.distortion_model not in ("", "plumb_bob", "rational_polynomial"):
        raise UserError(
            f"camera_info: got distortion_model {message.distortion_model!r}, expected plumb_bob or "
            "rational_polynomial; rectify the images before"
        )
    k = [float(number) for number in (message.k if hasattr(message, "k") else message.K)]
    d = tuple(float(number) for number in (message.d if hasattr(message, "d") else message.D))
    return Intrinsics(int(message.width), int(message.height), k[0], k[4], k[2], k[5], d if any(d) else ())


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
    """Colour and depth that belong together, of messages that come one by one.

    Args:
        tolerance: seconds between the two, at most.
        most: of each kind that wait for a partner.

    """

    def __init__(self, tolerance: float, most: int = 30) -> None:
        self.tolerance = round(tolerance * SECOND)
        self.most = most
        self._given_up = 0
        self._waiting: dict[str, deque[tuple[Stamp, T]]] = {"colour": deque(), "depth": deque()}

    @property
    def alone(self) -> int:
        """Messages that have found no partner."""
        return self._given_up + sum(map(len, self._waiting.values()))

    def add(self, kind: str, stamp: Stamp, item: T) -> tuple[Stamp, T, T] | None:
        """Add a message of the kind `colour` or `depth`; the pair that it completes, as (stamp, colour, depth).

        What waited longer than its partner is given up.
        """
        mine, others = self._waiting[kind], self._waiting["depth" if kind == "colour" else "colour"]
        near = [(abs(other - stamp), index) for index, (other, _) in enumerate(others)]
        distance, index = min(near, default=(self.tolerance + 1, 0))
        if distance > self.tolerance:
            mine.append((stamp, item))
            if len(mine) > self.most:
                mine.popleft()
                self._given_up += 1
            return None
        partner_stamp, partner = others[index]
        for _ in range(index + 1):
            others.popleft()
        self._given_up += index + len(mine)
        mine.clear()
        if kind == "colour":
            return stamp, item, partner
        return partner_stamp, partner, item
