"""Image encoders: RGB in, one feature map out. Any timm model that offers features_only."""

import difflib
from typing import Any

import timm
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from imagination.models.resizing import resize
from imagination.utils.errors import UserError

EARLY_STRIDES = (4, 8)
"""Pixels per feature of the stages that are kept; of ResNet-18 these are its first two, 64 and 128 channels."""


class TimmEncoder(nn.Module):
    """The early stages of a timm model, brought to the coarsest one's size and concatenated.

    Images are normalised here, with the mean and deviation that the model was made for. A model without stages of
    the strides in `EARLY_STRIDES` (a plain vision transformer, say) gives the last of its finest feature maps.

    Args:
        name: of the model, as timm knows it.
        height, width: of the images, pixels.
        shrink: the images are made smaller by this factor first, each pixel the mean of a square of that many a side.
        pretrained: start from timm's weights, which are downloaded once; otherwise from random ones.

    Attributes:
        channels: of the feature map.

    Raises:
        UserError: if the images cannot be shrunk so, timm has no such model, it offers no feature maps or cannot
            take images of this size, or its weights cannot be had.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, name: str, height: int, width: int, shrink: int = 1, pretrained: bool = False) -> None:
        super().__init__()
        check_name(name)
        check_shrink(shrink, height, width)
        self.shrink = shrink
        options = size_options(name, height // shrink, width // shrink)
        stages = early_stages(create(name, False, options).feature_info.reduction())
        self.model = create(name, pretrained, options | {"out_indices": stages})
        settings = timm.get_pretrained_cfg(name)
        assert settings is not None, "check_name lets only models through that timm has settings of"
        self.register_buffer("mean", 255 * torch.tensor(settings.mean).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", 255 * torch.tensor(settings.std).view(3, 1, 1), persistent=False)
        self.channels = self._try_out(name, height, width)

    def forward(self, rgb: UInt8[Tensor, "b 3 h w"]) -> Float[Tensor, "b c p q"]:
        """Features of the images: (B, `channels`, rows, columns)."""
        images = avg_pool2d(rgb.float(), self.shrink) if self.shrink > 1 else rgb
        maps = self.model((images - self.mean) / self.deviation)
        if str(getattr(self.model, "output_fmt", "NCHW")).endswith("NHWC"):
            maps = [features.permute(0, 3, 1, 2) for features in maps]
        rows, columns = maps[-1].shape[-2:]
        finer = [resize(features, rows, columns, "area") for features in maps[:-1]]
        return torch.cat([*finer, maps[-1]], dim=1)

    def _try_out(self, name: str, height: int, width: int) -> int:
        """Channels that an image of this size gives; weights that it does not reach are frozen.

        Some models keep their late stages though none of their features are asked for. Distributed training refuses
        weights that wait for a gradient and get none.
        """
        self.eval()
        try:
            features: Tensor = self(torch.zeros(1, 3, height, width, dtype=torch.uint8))
        except (AssertionError, RuntimeError, ValueError) as error:
            raise UserError(
                f"model.encoder.name: got {name!r}, which cannot take images of {height} x {width} pixels ({error}); "
                "choose another encoder or another camera size"
            ) from error
        weights = list(self.parameters())
        gradients = torch.autograd.grad(features.sum(), weights, allow_unused=True)
        for weight, gradient in zip(weights, gradients, strict=True):
            weight.requires_grad_(gradient is not None)
        self.train()
        return features.shape[1]


def check_name(name: str) -> None:
    """Refuse a name that timm does not know.

    Raises:
        UserError: with the names that come closest.
    """
    names = timm.list_models() + timm.list_pretrained()  # the latter are of the form model.weights
    if name not in names:
        close = difflib.get_close_matches(name, names, n=5, cutoff=0.4)
        raise UserError(
            f"model.encoder.name: got {name!r}, expected a model of timm; "
            f"the closest names are: {', '.join(close) or '(none)'}; timm.list_models() lists all"
        )


def check_shrink(shrink: int, height: int, width: int) -> None:
    """Refuse a factor that leaves pixels over.

    Raises:
        UserError: with the image's size.
    """
    if shrink < 1 or height % shrink or width % shrink:
        raise UserError(
            f"model.encoder.shrink: got {shrink}, expected a whole number from 1 that divides the image's sides, "
            f"{height} and {width} pixels (scale.encoder_shrink)"
        )


def size_options(name: str, height: int, width: int) -> dict[str, Any]:
    """What to create the model with so that it takes images of the camera's size."""
    settings = timm.get_pretrained_cfg(name)
    return {"img_size": (height, width)} if settings and settings.fixed_input_size else {}


def create(name: str, pretrained: bool, options: dict[str, Any]) -> Any:
    """Create a timm model that returns feature maps; timm has no one type for these.

    Raises:
        UserError: with timm's reason, if it cannot be created or its weights cannot be loaded.
    """
    try:
        return timm.create_model(name, pretrained=pretrained, features_only=True, **options)
    except (OSError, RuntimeError, TypeError, ValueError, AttributeError, AssertionError) as error:
        what = "weights cannot be loaded" if pretrained else "feature maps cannot be had"
        advice = "set model.encoder.pretrained=false or go online" if pretrained else "choose another encoder"
        asked = "".join(f", {key}={value}" for key, value in options.items())
        message = f"model.encoder.name: got {name!r}{asked}, whose {what} ({error}); {advice}"
        raise UserError(message) from error


def early_stages(strides: list[int]) -> list[int]:
    """Which feature maps to use, given each one's stride: those of `EARLY_STRIDES`, else the last of the finest."""
    low, high = EARLY_STRIDES
    early = [index for index, stride in enumerate(strides) if low <= stride <= high]
    return early or [max(index for index, stride in enumerate(strides) if stride == min(strides))]
