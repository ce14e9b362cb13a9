"""Compressed images from anywhere, decoded only if their header states a size that is allowed."""

from io import BytesIO

import cv2
import numpy as np
from PIL import Image

from imagination.utils.errors import UserError


def decode(data: bytes, flags: int, most: int) -> np.ndarray:
    """Decode an image; its size is checked before anything is allocated, since a few bytes can unpack to gigabytes.

    Args:
        data: of the file.
        flags: of OpenCV's imdecode.
        most: pixels a side.

    Raises:
        UserError: if it is no image that can be read, or larger.
    """
    size = stated_size(data)
    if size is not None and max(size) > most:
        raise UserError(f"got {size[0]} x {size[1]} pixels, expected at most {most} a side")
    try:
        image = None if size is None else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # a header that Pillow takes and OpenCV does not
        image = None
    if image is None:
        raise UserError(f"{len(data)} bytes that are no image")
    return image


def stated_size(data: bytes) -> tuple[int, int] | None:
    """Width and height by the header, None if no reader of Pillow's takes it.

    Image.open would do, but for its own limit of pixels, which maps may exceed.
    """
    Image.init()
    for reader, accepts in (Image.OPEN[name] for name in Image.ID):
        try:
            if accepts is None or accepts(data[:16]) is True:
                with reader(BytesIO(data), "") as header:
                    return header.size
        except Exception:  # a damaged header makes readers raise anything
            continue
    return None
