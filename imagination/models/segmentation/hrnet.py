"""HRNetV2 (Wang et al. 2020, Deep High-Resolution Representation Learning) for first-person segmentation."""

from math import ceil
from typing import Any

import timm
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import interpolate

from imagination.models.backbones import Convolution
from imagination.models.resizing import resize
from imagination.utils.errors import check_choice, check_range

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's colours, RGB, 0 to 1, of all HRNets and the public ADE20K release."""

STRIDE = 32
"""Stride of the coarsest resolution, pixels."""


class HRNetV2(nn.Module):
    """HRNet of timm, whose four resolutions are resized to the finest and concatenated, with a convolutional head.

    The head is `c1` of the public release: a 3 x 3 convolution to a quarter of the channels, then a 1 x 1 convolution.
    Branches are fused by bilinear interpolation, as in HRNetV2; timm's classifiers use nearest-neighbour interpolation.

    Args:
        name: name of the network in timm, one of hrnet_*.
        classes: number of classes.
        enlarge: factor by which images are first enlarged; features have a quarter of the enlarged rows and columns.

    Raises:
        UserError: if timm has no such network or the factor is out of range.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, name: str, classes: int, enlarge: float = 1.0) -> None:
        super().__init__()
        check_choice("model.network.name", name, timm.list_models("hrnet_*"))
        self.enlarge = check_range("model.network.enlarge", enlarge, 1.0, 16.0)
        encoder: Any = timm.create_model(
            name, features_only=True, feature_location="", out_indices=(1, 2, 3, 4)
        )
        for parent in encoder.modules():
            for child_name, child in parent.named_children():
                if isinstance(child, nn.Upsample):
                    assert isinstance(child.scale_factor, float)
                    setattr(parent, child_name, Enlarge(int(child.scale_factor)))
        channels = sum(branch[-1].conv2.out_channels for branch in encoder.stage4[-1].branches)
        self.encoder = encoder
        self.decoder = nn.Sequential(
            Convolution(channels, channels // 4), nn.Conv2d(channels // 4, classes, 1)
        )
        self.register_buffer("mean", 255 * torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", 255 * torch.tensor(DEVIATION).view(3, 1, 1), persistent=False)
        self.to(memory_format=torch.channels_last)

    def forward(self, rgb: UInt8[Tensor, "b 3 h w"]) -> Float[Tensor, "b k p q"]:
        """Return the logits of the classes, at a quarter of the (enlarged) image's rows and columns."""
        image = (rgb - self.mean) / self.deviation
        # a multiple of the coarsest stride, so that the resolutions align
        size = [STRIDE * ceil(self.enlarge * side / STRIDE) for side in rgb.shape[-2:]]
        if size != list(rgb.shape[-2:]):
            image = interpolate(image, size=size, mode="bilinear", align_corners=False)
        features = self.encoder(image)
        logits: Tensor = self.decoder(
            torch.cat([resize(resolution, *features[0].shape[-2:]) for resolution in features], dim=1)
        )
        return logits


class Enlarge(nn.Module):
    """Bilinear upsampling by an integer factor."""

    def __init__(self, factor: int) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c p q"]:
        height, width = features.shape[-2:]
        return resize(features, self.factor * height, self.factor * width)


def at_size(logits: Float[Tensor, "b k p q"], rows: int, columns: int) -> Float[Tensor, "b k rows columns"]:
    """Resize logits to the pixels of an image, in single precision."""
    return resize(logits.float(), rows, columns)
