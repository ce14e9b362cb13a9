"""Decoding of recorded images to arrays: colour to RGB, depth to metres."""

import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from imagination.recordings.recording import BrokenRecordingError
from imagination.utils.errors import UserError
from imagination.utils.image_decoding import decode

MAX_SIDE = 8192
"""Largest image side, pixels; larger images are refused before any memory is allocated."""

COMPRESSED_DEPTH_HEADER = struct.Struct("<iff")
"""Header of ROS' compressedDepth: format and the two parameters of the inverse depth coding of float images."""


def read_colour(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as RGB.

    Raises:
        BrokenRecordingError: if the file is missing or damaged.
    """
    return decode_colour(_bytes(path), str(path))


def read_depth(path: Path, scale: float) -> Float32[np.ndarray, "h w"]:
    """Read a depth image: 16-bit PNG or PGM, .npy, or any image of one channel that OpenCV reads.

    Args:
        path: path of the file.
        scale: units per metre of integer depth; floats are metres.

    Raises:
        BrokenRecordingError: if the file is missing, damaged or has three channels.
    """
    if path.suffix == ".npy":
        try:
            raw = np.load(path, allow_pickle=False)
        except Exception as error:  # NumPy raises many types on a damaged header
            raise BrokenRecordingError(f"{path}: cannot be read ({error})") from error
        if not isinstance(raw, np.ndarray) or raw.ndim != 2 or raw.dtype.kind not in "fiu":
            raise BrokenRecordingError(
                f"{path}: got no two-dimensional array of numbers, expected rows x columns of depth"
            )
    else:
        raw = decode_depth(_bytes(path), str(path))
    return to_metres(raw, 1.0 if np.issubdtype(raw.dtype, np.floating) else scale)


def decode_colour(data: bytes, origin: str) -> UInt8[np.ndarray, "h w 3"]:
    """Decode a compressed colour image.

    Raises:
        BrokenRecordingError: if the data cannot be decoded.
    """
    return _decode(data, cv2.IMREAD_COLOR_RGB, origin)


def decode_depth(data: bytes, origin: str) -> np.ndarray:
    """Decode a compressed image of one channel without converting its values.

    Raises:
        BrokenRecordingError: if the data cannot be decoded or have several channels.
    """
    image = _decode(data, cv2.IMREAD_UNCHANGED, origin)
    if image.ndim != 2 or image.dtype == np.uint8:
        raise BrokenRecordingError(
            f"{origin}: got {image.dtype} of shape {image.shape}, expected depth, one channel of 16 bits or floats"
        )
    return image


def decode_compressed_depth(data: bytes, encoding: str, origin: str) -> np.ndarray:
    """Decode ROS' compressedDepth: a header followed by a PNG of the depth (16UC1) or of its inverse (32FC1).

    See the ROS package compressed_depth_image_transport for the format.
    """
    if len(data) <= COMPRESSED_DEPTH_HEADER.size:
        raise BrokenRecordingError(f"{origin}: got {len(data)} bytes, expected a compressedDepth image")
    _, a, b = COMPRESSED_DEPTH_HEADER.unpack_from(data)
    image = decode_depth(data[COMPRESSED_DEPTH_HEADER.size :], origin)
    if not encoding.startswith("32FC1"):
        return image
    return np.where(image > 0, a / np.maximum(image.astype(np.float32) - np.float32(b), 1e-6), 0).astype(
        np.float32
    )


def to_metres(raw: np.ndarray, scale: float) -> Float32[np.ndarray, "h w"]:
    """Convert depth to metres; holes (0, NaN, infinite or negative values) become 0.

    Args:
        raw: depth image.
        scale: units per metre, e.g. 1000 for millimetres.
    """
    depth = raw.astype(np.float32) / np.float32(scale)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _decode(data: bytes, flags: int, origin: str) -> np.ndarray:
    try:
        return decode(data, flags, MAX_SIDE)
    except UserError as error:
        raise BrokenRecordingError(f"{origin}: {error}") from error


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:  # the path in a list may be invalid, e.g. contain null bytes
        raise BrokenRecordingError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error
