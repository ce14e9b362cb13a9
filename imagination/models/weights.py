"""Weights that do not fit a network."""

from collections.abc import Mapping

from torch import Tensor

SHOWN = 3
"""Mismatches that an error lists."""


def mismatches(weights: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> str:
    """How many entries differ in name or shape and the first of them, with both shapes; empty if none does.

    Args:
        weights: got.
        expected: the network's own.
    """
    found = [
        f"{name}: got {_shape(weights.get(name))}, expected {_shape(expected.get(name))}"
        for name in dict.fromkeys([*expected, *weights])
        if _shape(weights.get(name)) != _shape(expected.get(name))
    ]
    return f"{len(found)} entries differ, first {'; '.join(found[:SHOWN])}" if found else ""


def _shape(tensor: Tensor | None) -> str:
    return "none" if tensor is None else f"{tuple(tensor.shape)}"
