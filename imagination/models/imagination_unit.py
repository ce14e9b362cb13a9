"""The imagination unit of the paper (section III-B): image encoder and map backbone."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Float16, UInt8
from torch import Tensor

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.models.backbones import Backbone
from imagination.models.encoders import TimmEncoder
from imagination.models.height_bands import HeightBands
from imagination.models.unit import Unit, prediction_head, window_cells


class ImaginationUnit(Unit):
    """Encoder for the image, backbone for the egocentric depth projection; the image's features join on its way down.

    The paper's projection is `occupied` and `seen`. Ours has a layer for each band of heights beside them, since
    occupancy alone does not tell a chair from a washbasin; no bands (`scale.heights=[]`, as at `scale=paper`) gives
    the paper's.

    Args:
        encoder: images to features.
        backbone: makes a backbone, given `in_channels` and `image_channels`.
        camera: that takes the images.
        ego: grid of the maps.
        heights: bounds of the bands above the floor, ascending, metres; fewer than two give no band.
        height_jitter: while training, the heights in a view are scaled by a random factor of 1 ± this.
        categories, tta_hflip: as of every `Unit`.
        postprocess_dilation: side of its square, metres.

    Raises:
        UserError: if the heights do not ascend or the jitter is out of range.
    """

    def __init__(
        self,
        encoder: TimmEncoder,
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
        """See `Unit`."""
        maps = torch.cat([occupied.float(), seen.float(), self.bands(depth)], dim=1)
        logits: Tensor = self.head(self.backbone(maps, self.encoder(rgb)))
        return logits
