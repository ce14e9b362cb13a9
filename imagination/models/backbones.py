"""Backbones, which map egocentric maps to `width` channels of features on the same grid.

The backbones have the same downsampling path, that of OccupancyAnticipation: five levels of 1, 1/2, 1/4, 1/8 and 1/16
of the grid's resolution with 1, 2, 4, 8 and 8 times `width` channels. They differ in the upsampling path. Sizes are
rounded up when downsampling and restored from the skip connections when upsampling, so that grids of any size work.
"""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn

from imagination.models.resizing import resize
from imagination.utils.errors import check_range

GROWTH = (1, 2, 4, 8, 8)
"""Channels of each level, multiples of the width."""

MERGED = 3
"""Number of coarsest levels into which image features are merged."""


class Backbone(nn.Module, ABC):
    """Downsampling path with merged image features; a subclass adds the upsampling path.

    Args:
        in_channels: number of channels of the maps.
        image_channels: number of channels of the image features, 0 without image features.
        width: number of channels of the finest level and of the output.
    """

    def __init__(self, in_channels: int, image_channels: int, width: int) -> None:
        super().__init__()
        check_range("model.backbone.width", width, 1, 1024, "channels")
        self.width = width
        self.channels = channels = [width * factor for factor in GROWTH]
        self.down = nn.ModuleList(map(Convolutions, [in_channels, *channels[:-1]], channels))
        self.pool = nn.MaxPool2d(2, ceil_mode=True)
        if image_channels:
            merged = channels[-MERGED:]
            # reduced first, because an encoder may return hundreds of channels
            self.reduce = Convolution(image_channels, merged[0], kernel=1)
            self.image_down = nn.ModuleList(map(Convolutions, [merged[0], *merged[:-1]], merged))
            self.merge = nn.ModuleList([Convolution(2 * size, size, kernel=1) for size in merged])

    def forward(
        self, maps: Float[Tensor, "b i v v"], image: Float[Tensor, "b c p q"] | None = None
    ) -> Float[Tensor, "b o v v"]:
        """Return decoded features of every cell: (B, `width`, V, V).

        Args:
            maps: egocentric maps.
            image: features of the camera image in the image's perspective; they are resized to the grid, and the
                network learns their place in it.
        """
        levels = [maps]
        for index, convolutions in enumerate(self.down):
            levels.append(convolutions(self.pool(levels[-1]) if index else maps))
        levels = levels[1:]
        if image is not None:
            levels[-MERGED:] = self._merge(levels[-MERGED:], image)
        return self.decode(levels)

    @abstractmethod
    def decode(self, levels: list[Tensor]) -> Tensor:
        """Decode the levels, finest first, to the size of the grid."""

    def _merge(self, levels: list[Tensor], image: Tensor) -> list[Tensor]:
        merged = []
        image = self.reduce(image)
        for level, convolutions, merge in zip(levels, self.image_down, self.merge, strict=True):
            image = convolutions(resize(image, *level.shape[-2:]))
            merged.append(merge(torch.cat([level, image], dim=1)))
        return merged


class UNet(Backbone):
    """U-Net (Ronneberger et al. 2015): skip connections join levels of the same size by concatenation."""

    def __init__(self, in_channels: int, image_channels: int, width: int) -> None:
        super().__init__(in_channels, image_channels, width)
        skips = self.channels[-2::-1]
        outputs = [*skips[1:], width]
        inputs = [self.channels[-1], *outputs[:-1]]
        self.up = nn.ModuleList(
            Convolutions(below + skip, output)
            for below, skip, output in zip(inputs, skips, outputs, strict=True)
        )

    def decode(self, levels: list[Tensor]) -> Tensor:
        features = levels[-1]
        for skip, convolutions in zip(levels[-2::-1], self.up, strict=True):
            features = convolutions(torch.cat([resize(features, *skip.shape[-2:]), skip], dim=1))
        return features


class FPN(Backbone):
    """Feature pyramid network (Lin et al. 2017): levels of equal width are added; the output sums all levels."""

    def __init__(self, in_channels: int, image_channels: int, width: int) -> None:
        super().__init__(in_channels, image_channels, width)
        self.lateral = nn.ModuleList(nn.Conv2d(channels, width, 1) for channels in self.channels)
        self.smooth = nn.ModuleList(Convolution(width, width) for _ in self.channels)

    def decode(self, levels: list[Tensor]) -> Tensor:
        features = self.lateral[-1](levels[-1])
        size = levels[0].shape[-2:]
        result = resize(self.smooth[-1](features), *size)
        for index in range(len(levels) - 2, -1, -1):
            features = self.lateral[index](levels[index]) + resize(features, *levels[index].shape[-2:])
            result = result + resize(self.smooth[index](features), *size)
        return result


class Convolution(nn.Sequential):
    """Convolution that preserves the size, batch normalisation and ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3) -> None:
        convolution = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2, bias=False)
        super().__init__(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class Convolutions(nn.Sequential):
    """Two 3 x 3 convolutions."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(Convolution(inputs, outputs), Convolution(outputs, outputs))
