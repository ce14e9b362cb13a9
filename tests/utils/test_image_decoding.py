"""Images are refused by what their headers state."""

import warnings

import cv2
import numpy as np
import pytest

from imagination.utils.errors import UserError
from imagination.utils.image_decoding import decode, stated_size


@pytest.mark.parametrize("ending", [".png", ".ppm", ".bmp", ".jpg", ".tiff", ".webp"])
def test_the_size_of_every_kind_of_image(ending: str) -> None:
    data = cv2.imencode(ending, np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    assert stated_size(data) == (64, 48)
    assert decode(data, cv2.IMREAD_COLOR, 64).shape == (48, 64, 3)
    with pytest.raises(UserError, match="got 64 x 48 pixels, expected at most 63 a side"):
        decode(data, cv2.IMREAD_COLOR, 63)


def test_a_size_beyond_what_pillow_warns_of_is_told_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert stated_size(b"P5 12000 12000 255\n") == (12_000, 12_000)
        assert stated_size(b"P5 20001 20001 255\n") == (20_001, 20_001)


@pytest.mark.parametrize("data", [b"", b"BM", b"nothing", b"P5 -3 3 255\n", b"P5 2000000 1 255\n"])
def test_what_opencv_breaks_at_is_no_image(data: bytes) -> None:
    with pytest.raises(UserError, match=f"{len(data)} bytes that are no image"):
        decode(data, cv2.IMREAD_UNCHANGED, 10**7)
