"""Comparison of saved weights with those of a network."""

from collections.abc import Mapping

from torch import Tensor

MAX_SHOWN = 3
"""Maximum number of mismatches in an error message."""


def mismatches(weights: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> str:
    """Return the number of entries that differ in name or shape, and the first of them; empty if none differs.

    Args:
        weights: saved weights.
        expected: weights of the network.
    """
    differences = [
        f"{name}: got {_shape(weights.get(name))}, expected {_shape(expected.get(name))}"
        for name in dict.fromkeys([*expected, *weights])
        if _shape(weights.get(name)) != _shape(expected.get(name))
    ]
    if not differences:
        return ""
    return f"{len(differences)} entries differ, first {'; '.join(differences[:MAX_SHOWN])}"


def _shape(tensor: Tensor | None) -> str:
    return "none" if tensor is None else f"{tuple(tensor.shape)}"
