"""Resizing by matrix products, as on GPUs, compared with the library's values and gradients on the CPU."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import interpolate

from imagination.models.resizing import by_products, resize

SIDE = st.integers(1, 12)


@settings(deadline=None)  # the first call checks shapes for the first time
@given(
    st.tuples(SIDE, SIDE), st.tuples(SIDE, SIDE), st.sampled_from(["bilinear", "area"]), st.integers(0, 99)
)
def test_products_equal_the_library(old: tuple[int, int], new: tuple[int, int], mode: str, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    features = torch.rand(2, 3, *old, generator=generator, requires_grad=True)
    weights = torch.rand(2, 3, *new, generator=generator)
    actual, expected = by_products(features, *new, mode), interpolate(features, size=new, mode=mode)
    torch.testing.assert_close(actual, expected)
    ours, theirs = (
        torch.autograd.grad((resized * weights).sum(), features)[0] for resized in (actual, expected)
    )
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_data_type_and_the_memory_format_are_preserved(dtype: torch.dtype) -> None:
    features = torch.rand(2, 8, 5, 7).to(dtype, memory_format=torch.channels_last)
    with torch.autocast("cpu", torch.bfloat16):
        resized = by_products(features, 9, 4)
    assert resized.dtype == dtype and resized.is_contiguous(memory_format=torch.channels_last)
    expected = interpolate(features.float(), size=(9, 4), mode="bilinear")
    torch.testing.assert_close(
        resized.float(), expected, atol=1e-6 if dtype == torch.float32 else 0.02, rtol=0
    )


def test_an_empty_batch_stays_empty() -> None:
    """One of several ranks may have no view."""
    assert by_products(torch.rand(0, 3, 5, 6), 7, 4).shape == (0, 3, 7, 4)


def test_training_works_after_resizing_in_inference_mode() -> None:
    with torch.inference_mode():
        by_products(torch.rand(1, 1, 11, 13), 17, 19)
    features = torch.rand(1, 1, 11, 13, requires_grad=True)
    by_products(features, 17, 19).sum().backward()
    assert features.grad is not None


def test_the_same_size_is_the_same_map() -> None:
    features = torch.rand(1, 2, 5, 6)
    assert resize(features, 5, 6) is features
