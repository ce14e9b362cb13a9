"""Feature maps at other sizes, with gradients that are the same each time, on GPUs too."""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

MODES = {"bilinear": "linear", "area": "area"}
"""Of two dimensions, and the same of one."""


def resize(
    features: Float[Tensor, "b c h w"], rows: int, columns: int, mode: str = "bilinear"
) -> Float[Tensor, "b c rows columns"]:
    """Feature maps of other rows and columns, as `interpolate` makes them (corners not aligned).

    On GPUs by two matrix products: the gradients of PyTorch's own kernels there are sums in a random order or, where
    they offer another one, took nearly two thirds of a training step at the paper's scale.

    Args:
        features: as they are.
        rows: wanted.
        columns: wanted.
        mode: "bilinear", or "area" for means over the cells that fall together.
    """
    if features.shape[-2:] == (rows, columns):
        return features
    if features.is_cuda:
        return by_products(features, rows, columns, mode)
    return interpolate(features, size=(rows, columns), mode=mode)


def by_products(
    features: Float[Tensor, "b c h w"], rows: int, columns: int, mode: str = "bilinear"
) -> Float[Tensor, "b c rows columns"]:
    """`resize` by two matrix products; channels lie last in memory, whatever the other layers do."""
    height, width = features.shape[-2:]
    last = features.permute(0, 2, 3, 1)  # not copied where channels lie last in memory
    with torch.autocast(features.device.type, enabled=False):  # numbers stay of the kind that they are
        down = _weights(height, rows, mode, last.device).to(last.dtype) @ last.flatten(2)
        lines = down.view(len(last), rows, width, features.shape[1])
        across: Tensor = _weights(width, columns, mode, last.device).to(last.dtype) @ lines
    return across.permute(0, 3, 1, 2)


@lru_cache(maxsize=256)
@torch.inference_mode(False)  # or training could not go on with weights that an evaluation asked for first
@torch.no_grad()
def _weights(old: int, new: int, mode: str, device: torch.device) -> Float[Tensor, "new old"]:
    """Of each old value in each new one, found by resizing the unit vectors."""
    units = torch.eye(old, device=device)[None]
    return interpolate(units, size=new, mode=MODES[mode])[0].T.contiguous()
