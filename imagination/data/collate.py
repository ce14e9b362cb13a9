"""From stored views to what a network is trained on."""

import numpy as np
import torch
from torch import Tensor

from imagination.ground_truth.targets import label, neighbourhood
from imagination.views.collector import Views

Batch = dict[str, Tensor]
"""rgb u8 [b 3 h w]; depth f16 [b 1 h w]; occupied, seen u8 [b 1 v v]; label, neighbourhood u8 [b c v v].
For first-person segmentation: rgb, and segmentation u8 [b h w], 0 for none, else the category's place + 1."""

FIELDS = {
    "maps": ("pose", "rgb", "depth", "occupied", "seen", "object"),
    "images": ("pose", "rgb", "categories"),
}
"""Arrays of views that batches are made of, by what a network predicts: egocentric maps or first-person images."""


def assemble(views: Views, layers: list[int], imaginable: int, neighbour: int) -> Batch:
    """Make a batch: what a unit is given, and of its categories the label V_label and M*_seen.

    Args:
        views: stacked views.
        layers: rows of the category table that the unit imagines.
        imaginable: the kernel delta, cells.
        neighbour: the kernel epsilon, cells.
    """
    target = views["object"][:, layers]
    seen = views["seen"][:, None]
    maps = {
        "label": label(target, seen, imaginable),
        "neighbourhood": neighbourhood(target, seen, neighbour),
    }
    return {**observations(views), **{name: _as_bytes(value) for name, value in maps.items()}}


def assemble_images(views: Views, layers: list[int]) -> Batch:
    """Make a batch for first-person segmentation into some categories.

    Args:
        views: stacked views.
        layers: rows of the category table that are told apart; all others are none.
    """
    place = np.zeros(256, np.uint8)
    place[np.array(layers) + 1] = np.arange(1, len(layers) + 1)
    return {"rgb": _channels_first(views), "segmentation": torch.from_numpy(place[views["categories"]])}


def observations(views: Views) -> Batch:
    """What a unit is given of views: rgb, depth, occupied and seen."""
    return {
        "rgb": _channels_first(views),
        "depth": torch.from_numpy(views["depth"])[:, None],
        "occupied": _as_bytes(views["occupied"][:, None]),
        "seen": _as_bytes(views["seen"][:, None]),
    }


def _channels_first(views: Views) -> Tensor:
    return torch.from_numpy(views["rgb"]).permute(0, 3, 1, 2)  # stays channels-last in memory


def _as_bytes(mask: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(mask)).to(torch.uint8)
