"""Image encoders, which map RGB images to one feature map: any timm model that supports features_only."""

import difflib
from abc import ABC, abstractmethod
from typing import Any

import timm
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from imagination.models.resizing import resize
from imagination.utils.errors import UserError

EARLY_STRIDES = (4, 8)
"""Lowest and highest stride of the stages in use, pixels; of ResNet-18 these are the first two, 64 and 128 channels."""


class Encoder(nn.Module, ABC):
    """Base class of image encoders.

    Attributes:
        channels: number of channels of the feature map.
    """

    channels: int

    @abstractmethod
    def forward(self, rgb: UInt8[Tensor, "b 3 h w"]) -> Float[Tensor, "b c p q"]:
        """Return the features of the images: (B, `channels`, rows, columns)."""


class TimmEncoder(Encoder):
    """Early stages of a timm model, resized to the coarsest stage and concatenated.

    Images are normalised with the model's mean and standard deviation. A model without stages of the strides in
    `EARLY_STRIDES`, e.g. a plain vision transformer, contributes the last of its finest feature maps.

    Args:
        name: name of the model in timm.
        height, width: size of the images, pixels.
        shrink: factor by which images are first downsampled, by area averaging.
        pretrained: whether to load timm's pretrained weights, which are downloaded once.

    Attributes:
        channels: number of channels of the feature map.

    Raises:
        UserError: if the factor does not divide the image size, timm has no such model, the model has no feature maps
            or does not accept images of this size, or its weights cannot be loaded.
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
        assert settings is not None, "check_name accepts only models with pretrained settings"
        self.register_buffer("mean", 255 * torch.tensor(settings.mean).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", 255 * torch.tensor(settings.std).view(3, 1, 1), persistent=False)
        self.channels = self._freeze_unused(name, height, width)

    def forward(self, rgb: UInt8[Tensor, "b 3 h w"]) -> Float[Tensor, "b c p q"]:
        """Return the features of the images: (B, `channels`, rows, columns)."""
        images = avg_pool2d(rgb.float(), self.shrink) if self.shrink > 1 else rgb
        maps = self.model((images - self.mean) / self.deviation)
        if str(getattr(self.model, "output_fmt", "NCHW")).endswith("NHWC"):
            maps = [features.permute(0, 3, 1, 2) for features in maps]
        rows, columns = maps[-1].shape[-2:]
        finer = [resize(features, rows, columns, "area") for features in maps[:-1]]
        return torch.cat([*finer, maps[-1]], dim=1)

    def _freeze_unused(self, name: str, height: int, width: int) -> int:
        """Freeze the weights that do not affect the features and return the number of channels.

        Some models keep late stages whose features are not requested. Distributed training refuses trainable weights
        without a gradient.
        """
        self.eval()
        try:
            features: Tensor = self(torch.zeros(1, 3, height, width, dtype=torch.uint8))
        except (AssertionError, RuntimeError, ValueError) as error:
            raise UserError(
                f"model.encoder.name: got {name!r}, which does not accept images of {height} x {width} pixels "
                f"({error}); choose another encoder or another camera size"
            ) from error
        weights = list(self.parameters())
        gradients = torch.autograd.grad(features.sum(), weights, allow_unused=True)
        for weight, gradient in zip(weights, gradients, strict=True):
            weight.requires_grad_(gradient is not None)
        self.train()
        return features.shape[1]


def check_name(name: str) -> None:
    """Check that timm has a model of this name.

    Raises:
        UserError: if timm has none; the message lists the closest names.
    """
    # list_pretrained returns names of the form model.weights
    names = timm.list_models() + timm.list_pretrained()
    if name not in names:
        matches = difflib.get_close_matches(name, names, n=5, cutoff=0.4)
        raise UserError(
            f"model.encoder.name: got {name!r}, expected a model of timm; "
            f"the closest names are: {', '.join(matches) or '(none)'}; timm.list_models() lists all"
        )


def check_shrink(shrink: int, height: int, width: int) -> None:
    """Check that a downsampling factor divides the image size.

    Raises:
        UserError: if the factor does not divide the size.
    """
    if shrink < 1 or height % shrink or width % shrink:
        raise UserError(
            f"model.encoder.shrink: got {shrink}, expected a whole number from 1 that divides the image size, "
            f"{height} x {width} pixels; change model.encoder_shrink"
        )


def size_options(name: str, height: int, width: int) -> dict[str, Any]:
    """Return the options that create the model for images of the camera's size."""
    settings = timm.get_pretrained_cfg(name)
    return {"img_size": (height, width)} if settings and settings.fixed_input_size else {}


def create(name: str, pretrained: bool, options: dict[str, Any]) -> Any:
    """Create a timm model that returns feature maps; timm has no common type for such models.

    Raises:
        UserError: if the model cannot be created or its weights cannot be loaded.
    """
    try:
        return timm.create_model(name, pretrained=pretrained, features_only=True, **options)
    except (OSError, RuntimeError, TypeError, ValueError, AttributeError, AssertionError) as error:
        problem = "weights cannot be loaded" if pretrained else "feature maps cannot be created"
        advice = "set model.encoder.pretrained=false or go online" if pretrained else "choose another encoder"
        arguments = "".join(f", {key}={value}" for key, value in options.items())
        message = f"model.encoder.name: got {name!r}{arguments}, whose {problem} ({error}); {advice}"
        raise UserError(message) from error


def early_stages(strides: list[int]) -> list[int]:
    """Return the indices of the stages with strides in `EARLY_STRIDES`, otherwise of the last of the finest stages."""
    low, high = EARLY_STRIDES
    early = [index for index, stride in enumerate(strides) if low <= stride <= high]
    return early or [max(index for index, stride in enumerate(strides) if stride == min(strides))]
