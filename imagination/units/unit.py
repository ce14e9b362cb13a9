"""The imagination unit of the paper (section III-B)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from math import log

import torch
from jaxtyping import Float, Float16, UInt8
from torch import Tensor, nn

from imagination.units.backbones import Backbone
from imagination.units.encoders import TimmEncoder

PRIOR = 0.05
"""What an untrained unit answers about every cell: objects are rare, so training need not first learn that."""


class Unit(nn.Module, ABC):
    """What every unit is: one camera image and its depth in, logits of the egocentric maps of some categories out.

    Args:
        categories: what to imagine, one map each; the paper has one unit for each category.
    """

    def __init__(self, categories: Sequence[str]) -> None:
        super().__init__()
        self.categories = list(categories)

    @abstractmethod
    def forward(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """Logits of V_object; their sigmoid is the imagined map.

        Args:
            rgb: camera image, 0 to 255.
            depth: of the same camera along its optical axis, metres; 0 where there is no return.
            occupied, seen: the depth's projection into the egocentric grid, 0 or 1.
        """


class ImaginationUnit(Unit):
    """Encoder for the image, backbone for the egocentric depth projection; the image's features join on its way down.

    Args:
        encoder: images to features.
        backbone: makes a backbone, given `in_channels` and `image_channels`.
        categories: what to imagine, one map each; the paper has one unit for each category.
    """

    def __init__(
        self, encoder: TimmEncoder, backbone: Callable[..., Backbone], categories: Sequence[str]
    ) -> None:
        super().__init__(categories)
        self.encoder = encoder
        self.backbone = backbone(in_channels=2, image_channels=encoder.channels)
        self.head = prediction_head(self.backbone.width, len(categories))
        self.to(memory_format=torch.channels_last)

    def forward(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """Logits of V_object; see `Unit`. This unit knows the depth only through `occupied` and `seen`."""
        maps = torch.cat([occupied, seen], dim=1).to(self.head.weight.dtype)
        logits: Tensor = self.head(self.backbone(maps, self.encoder(rgb)))
        return logits


def prediction_head(width: int, categories: int) -> nn.Conv2d:
    """The last layer: logits of every category, about `PRIOR` to begin with."""
    head = nn.Conv2d(width, categories, 1)
    nn.init.constant_(head.bias, log(PRIOR / (1 - PRIOR)))  # type: ignore[arg-type]
    return head
