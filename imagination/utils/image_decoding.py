"""Decoding of compressed images from untrusted files, with a limit on the size in their header."""

from io import BytesIO

import cv2
import numpy as np
from PIL import Image

from imagination.utils.errors import UserError


def decode(data: bytes, flags: int, max_side: int) -> np.ndarray:
    """Decode an image after a check of its size, since a few bytes can unpack to gigabytes.

    Args:
        data: content of the file.
        flags: flags of cv2.imdecode.
        max_side: largest width and height, pixels.

    Raises:
        UserError: if the data cannot be decoded, or the image is larger.
    """
    size = stated_size(data)
    if size is not None and max(size) > max_side:
        raise UserError(f"got {size[0]} x {size[1]} pixels, expected at most {max_side} a side")
    try:
        image = None if size is None else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # Pillow reads some headers that OpenCV rejects
        image = None
    if image is None:
        raise UserError(f"got {len(data)} bytes, expected a readable image")
    return image


def stated_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the header, or None if no plugin of Pillow can read it.

    Image.open is not used, because maps may exceed its limit on the number of pixels.
    """
    Image.init()
    for reader, accepts in (Image.OPEN[name] for name in Image.ID):
        try:
            if accepts is None or accepts(data[:16]) is True:
                with reader(BytesIO(data), "") as header:
                    return header.size
        except Exception:  # damaged headers raise any type of exception
            continue
    return None
