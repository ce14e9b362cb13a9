"""The variant that carries image features to the egocentric grid through depth."""

from collections.abc import Callable, Sequence
from math import inf

import torch
from jaxtyping import Float, Float16, UInt8
from torch import Tensor, nn

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.models.backbones import Backbone, Convolution
from imagination.models.depth_hits import DepthHits
from imagination.models.encoders import TimmEncoder
from imagination.models.resizing import resize
from imagination.models.unit import Unit, prediction_head, window_cells


class ProjectedUnit(Unit):
    """Each return's image features, and its height, go to the cell it lies in; a cell takes the mean of its returns.

    What the image shows thus meets `occupied` and `seen` at its place in the grid, before the backbone; the paper's
    unit has to learn where in the image a cell's features are.

    Args:
        encoder: images to features.
        backbone: makes a backbone, given `in_channels` and `image_channels`.
        camera: that took the images.
        ego: grid of the maps.
        max_height: metres above the floor; higher returns, of lamps and ceilings, are left out.
        width: channels of the image features that are carried over.
        categories, tta_hflip: as of every `Unit`.
        postprocess_dilation: side of its square, metres.
    """

    def __init__(
        self,
        encoder: TimmEncoder,
        backbone: Callable[..., Backbone],
        camera: Camera,
        ego: EgoGrid,
        max_height: float,
        width: int,
        categories: Sequence[str],
        tta_hflip: bool = False,
        postprocess_dilation: float = 0.0,
    ) -> None:
        super().__init__(categories, tta_hflip, window_cells(postprocess_dilation, ego))
        self.encoder = encoder
        self.reduce = Convolution(encoder.channels, width, kernel=1)
        self.projection = Projection(camera, ego, max_height)
        self.backbone = backbone(in_channels=2 + width + 1, image_channels=0)
        self.head = prediction_head(self.backbone.width, len(categories))

    def logits(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """See `Unit`. The images are of the camera's size."""
        image = resize(self.reduce(self.encoder(rgb)), *depth.shape[-2:])
        maps = [occupied.float(), seen.float(), self.projection(image, depth)]
        logits: Tensor = self.head(self.backbone(torch.cat(maps, dim=1)))
        return logits


class Projection(nn.Module):
    """Means over the egocentric grid's cells of what an image shows in them."""

    def __init__(self, camera: Camera, ego: EgoGrid, max_height: float) -> None:
        super().__init__()
        self.ego = ego
        self.max_height = max_height
        self.depth_hits = DepthHits(camera, ego)

    def forward(
        self, image: Float[Tensor, "b c h w"], depth: Float16[Tensor, "b 1 h w"]
    ) -> Float[Tensor, "b c+1 v v"]:
        """Mean of the features of the returns in each cell, and of their height in metres; 0 where there is none.

        Args:
            image: features of each pixel; gradients flow back to them.
            depth: metres along the optical axis, 0 where there is no return.

        Raises:
            UserError: if the images are not of the camera's size.
        """
        batch, channels = image.shape[:2]
        cells, height = self.depth_hits(depth, -inf, self.max_height)
        values = torch.cat([image.float(), height[:, None], torch.ones_like(height)[:, None]], dim=1)
        rows = values.permute(0, 2, 3, 1).reshape(-1, channels + 2)
        # one row a cell, and a last one for the returns that lie in none
        sums = rows.new_zeros(batch * self.ego.cells**2 + 1, channels + 2)
        sums = sums.scatter_add(0, cells.reshape(-1, 1).expand_as(rows), rows)[:-1]
        means = sums[:, :-1] / sums[:, -1:].clamp(min=1)
        return means.view(batch, self.ego.cells, self.ego.cells, channels + 1).permute(0, 3, 1, 2)
