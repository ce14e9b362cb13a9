"""Imagination unit of the paper (section IV-B): image encoder and map backbone."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Float16, UInt8
from torch import Tensor

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.models.backbones import Backbone
from imagination.models.encoders import Encoder
from imagination.models.height_bands import HeightBands
from imagination.models.unit import Unit, prediction_head, window_cells


class ImaginationUnit(Unit):
    """Unit whose backbone processes the egocentric depth projection and merges the image features of an encoder.

    The paper's projection consists of `occupied` and `seen`. Ours adds one layer per band of heights, because occupancy
    alone does not distinguish a chair from a washbasin. Without bands (`model.heights=[]`, as at `scale=paper`) the
    projection is the paper's.

    Args:
        encoder: encoder of the camera image.
        backbone: factory of the backbone, called with `in_channels` and `image_channels`.
        camera: camera of the images.
        ego: grid of the maps.
        heights: bounds of the bands above the floor, ascending, metres; fewer than two give no band.
        height_jitter: maximum relative change of the heights, drawn for each view in training.
        categories: names of the categories.
        tta_hflip: whether to use horizontal-flip test-time augmentation; see `Unit`.
        postprocess_dilation: side of the window of averaging and dilation, metres; see `Unit`.

    Raises:
        UserError: if the heights do not ascend or the jitter is out of range.
    """

    def __init__(
        self,
        encoder: Encoder,
        backbone: Callable[..., Backbone],
        camera: Camera,
        ego: EgoGrid,
        heights: Sequence[float],
        height_jitter: float,
        categories: Sequence[str],
        tta_hflip: bool = False,
        postprocess_dilation: float = 0.0,
    ) -> None:
        super().__init__(categories, tta_hflip, window_cells(postprocess_dilation, ego))
        self.encoder = encoder
        self.bands = HeightBands(camera, ego, heights, height_jitter)
        self.backbone = backbone(in_channels=2 + self.bands.count, image_channels=encoder.channels)
        self.head = prediction_head(self.backbone.width, len(categories))

    def logits(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """Return the logits of V_object; see `Unit`."""
        maps = torch.cat([occupied.float(), seen.float(), self.bands(depth)], dim=1)
        logits: Tensor = self.head(self.backbone(maps, self.encoder(rgb)))
        return logits
