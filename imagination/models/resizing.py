"""Resizing of feature maps with deterministic gradients, on GPUs as well."""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

MODES = {"bilinear": "linear", "area": "area"}
"""Interpolation modes for two dimensions, and the corresponding modes for one dimension."""


def resize(
    features: Float[Tensor, "b c h w"], rows: int, columns: int, mode: str = "bilinear"
) -> Float[Tensor, "b c rows columns"]:
    """Resize feature maps as `interpolate` does (corners not aligned).

    On GPUs, resizing uses two matrix products, because PyTorch's kernels sum gradients in a random order or, in their
    deterministic version, took nearly two thirds of a training step at the paper's scale.

    Args:
        features: feature maps.
        rows: number of output rows.
        columns: number of output columns.
        mode: "bilinear", or "area" for means over the merged cells.
    """
    if features.shape[-2:] == (rows, columns):
        return features
    if features.is_cuda:
        return by_products(features, rows, columns, mode)
    return interpolate(features, size=(rows, columns), mode=mode)


def by_products(
    features: Float[Tensor, "b c h w"], rows: int, columns: int, mode: str = "bilinear"
) -> Float[Tensor, "b c rows columns"]:
    """Resize by two matrix products, in the channels-last memory format; see `resize`."""
    height, width = features.shape[-2:]
    last = features.permute(0, 2, 3, 1)  # no copy in the channels-last memory format
    with torch.autocast(features.device.type, enabled=False):  # preserves the data type
        vertical = _weights(height, rows, mode, last.device).to(last.dtype) @ last.flatten(2)
        lines = vertical.view(len(last), rows, width, features.shape[1])
        resized: Tensor = _weights(width, columns, mode, last.device).to(last.dtype) @ lines
    return resized.permute(0, 3, 1, 2)


@lru_cache(maxsize=256)
@torch.inference_mode(False)  # training can use weights that an evaluation has cached
@torch.no_grad()
def _weights(old: int, new: int, mode: str, device: torch.device) -> Float[Tensor, "new old"]:
    """Return the weight of each input value in each output value, by resizing the unit vectors."""
    units = torch.eye(old, device=device)[None]
    return interpolate(units, size=new, mode=MODES[mode])[0].T.contiguous()
