"""Horizontal-flip test-time augmentation."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor


def average_with_hflip(
    network: Callable[..., Float[Tensor, "b c h w"]], *inputs: Tensor
) -> Float[Tensor, "b c h w"]:
    """Return the mean of the logits of the inputs and of their mirror images, which are flipped back.

    Args:
        network: maps the inputs to logits.
        inputs: images and maps whose last axis runs from left to right.
    """
    logits = network(*inputs)
    mirrored = network(*(values.flip(-1) for values in inputs))
    return (logits + mirrored.flip(-1)) / 2
