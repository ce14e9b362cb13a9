"""Decoding of images: the size in the header is checked first."""

import warnings

import cv2
import numpy as np
import pytest

from imagination.utils.errors import UserError
from imagination.utils.image_decoding import decode, stated_size


@pytest.mark.parametrize("ending", [".png", ".ppm", ".bmp", ".jpg", ".tiff", ".webp"])
def test_size_in_the_header_of_each_format(ending: str) -> None:
    data = cv2.imencode(ending, np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    assert stated_size(data) == (64, 48)
    assert decode(data, cv2.IMREAD_COLOR, 64).shape == (48, 64, 3)
    with pytest.raises(UserError, match="got 64 x 48 .*63"):
        decode(data, cv2.IMREAD_COLOR, 63)


def test_size_above_the_limit_of_pillow_is_read_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert stated_size(b"P5 12000 12000 255\n") == (12_000, 12_000)
        assert stated_size(b"P5 20001 20001 255\n") == (20_001, 20_001)


@pytest.mark.parametrize("data", [b"", b"BM", b"nothing", b"P5 -3 3 255\n", b"P5 2000000 1 255\n"])
def test_invalid_images_are_refused(data: bytes) -> None:
    with pytest.raises(UserError, match=f"got {len(data)} bytes"):
        decode(data, cv2.IMREAD_UNCHANGED, 10**7)
