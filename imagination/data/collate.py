"""Batches for training, assembled from stored views."""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from imagination.ground_truth.targets import label, neighbourhood
from imagination.views.collector import Views

Batch = dict[str, Tensor]
"""rgb u8 [b 3 h w]; depth f16 [b 1 h w]; occupied, seen u8 [b 1 v v]; label, neighbourhood u8 [b c v v].
Batches for first-person segmentation hold rgb and segmentation u8 [b h w]: 0 for background, else the category index
plus 1."""


class Collate(ABC):
    """Function that assembles a batch from stacked views, for one kind of task.

    Attributes:
        fields: names of the arrays of views that a batch needs.
    """

    fields: ClassVar[tuple[str, ...]]

    @abstractmethod
    def __call__(self, views: Views, layers: list[int], imaginable: int, neighbour: int) -> Batch:
        """Assemble a batch.

        Args:
            views: stacked views.
            layers: rows of the predicted categories in the category table.
            imaginable: side of the kernel δ, cells.
            neighbour: side of the kernel ε, cells.
        """


class MapCollate(Collate):
    """Batches of egocentric maps: the inputs of a unit, the label V_label and the neighbourhood M*_seen."""

    fields = ("pose", "rgb", "depth", "occupied", "seen", "object")

    def __call__(self, views: Views, layers: list[int], imaginable: int, neighbour: int) -> Batch:
        target = views["object"][:, layers]
        seen = views["seen"][:, None]
        maps = {
            "label": label(target, seen, imaginable),
            "neighbourhood": neighbourhood(target, seen, neighbour),
        }
        return {**observations(views), **{name: _to_uint8(value) for name, value in maps.items()}}


class ImageCollate(Collate):
    """Batches for first-person segmentation: images and their ground truth; other categories become background."""

    fields = ("pose", "rgb", "categories")

    def __call__(self, views: Views, layers: list[int], imaginable: int, neighbour: int) -> Batch:
        lookup = np.zeros(256, np.uint8)
        lookup[np.array(layers) + 1] = np.arange(1, len(layers) + 1)
        return {"rgb": _channels_first(views), "segmentation": torch.from_numpy(lookup[views["categories"]])}


def observations(views: Views) -> Batch:
    """Return the inputs of a unit: rgb, depth, occupied and seen."""
    return {
        "rgb": _channels_first(views),
        "depth": torch.from_numpy(views["depth"])[:, None],
        "occupied": _to_uint8(views["occupied"][:, None]),
        "seen": _to_uint8(views["seen"][:, None]),
    }


def _channels_first(views: Views) -> Tensor:
    return torch.from_numpy(views["rgb"]).permute(0, 3, 1, 2)  # stays channels-last in memory


def _to_uint8(mask: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(mask)).to(torch.uint8)
