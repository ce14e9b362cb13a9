"""Unit that projects image features into the egocentric grid by depth."""

from collections.abc import Callable, Sequence
from math import inf

import torch
from jaxtyping import Float, Float16, UInt8
from torch import Tensor, nn

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.models.backbones import Backbone, Convolution
from imagination.models.depth_hits import DepthHits
from imagination.models.encoders import Encoder
from imagination.models.resizing import resize
from imagination.models.unit import Unit, prediction_head, window_cells


class ProjectedUnit(Unit):
    """Unit that averages the image features and heights of the depth returns in each cell of the grid.

    Image features are thus aligned with `occupied` and `seen` before the backbone, whereas the paper's unit has to
    learn where in the image the features of a cell are.

    Args:
        encoder: encoder of the camera image.
        backbone: factory of the backbone, called with `in_channels` and `image_channels`.
        camera: camera of the images.
        ego: grid of the maps.
        max_height: maximum height of returns above the floor, metres, which leaves out lamps and ceilings.
        width: number of channels of the projected image features.
        categories: names of the categories.
        tta_hflip: whether to use horizontal-flip test-time augmentation; see `Unit`.
        postprocess_dilation: side of the window of averaging and dilation, metres; see `Unit`.
    """

    def __init__(
        self,
        encoder: Encoder,
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
        """Return the logits of V_object for images of the camera's size; see `Unit`."""
        image = resize(self.reduce(self.encoder(rgb)), *depth.shape[-2:])
        maps = [occupied.float(), seen.float(), self.projection(image, depth)]
        logits: Tensor = self.head(self.backbone(torch.cat(maps, dim=1)))
        return logits


class Projection(nn.Module):
    """Projection of image features into the egocentric grid, averaged in each cell.

    Args:
        camera: camera of the depth images.
        ego: grid of the maps.
        max_height: maximum height of returns above the floor, metres.
    """

    def __init__(self, camera: Camera, ego: EgoGrid, max_height: float) -> None:
        super().__init__()
        self.ego = ego
        self.max_height = max_height
        self.depth_hits = DepthHits(camera, ego)

    def forward(
        self, image: Float[Tensor, "b c h w"], depth: Float16[Tensor, "b 1 h w"]
    ) -> Float[Tensor, "b c+1 v v"]:
        """Return the mean features and the mean height, metres, of the returns in each cell; 0 in cells without one.

        Args:
            image: features of each pixel, to which gradients flow back.
            depth: depth along the optical axis, metres; 0 without a return.

        Raises:
            UserError: if the images do not have the camera's size.
        """
        batch, channels = image.shape[:2]
        cells, height = self.depth_hits(depth, -inf, self.max_height)
        values = torch.cat([image.float(), height[:, None], torch.ones_like(height)[:, None]], dim=1)
        rows = values.permute(0, 2, 3, 1).reshape(-1, channels + 2)
        # one row per cell, and a last row for returns outside all cells
        sums = rows.new_zeros(batch * self.ego.cells**2 + 1, channels + 2)
        sums = sums.scatter_add(0, cells.reshape(-1, 1).expand_as(rows), rows)[:-1]
        means = sums[:, :-1] / sums[:, -1:].clamp(min=1)
        return means.view(batch, self.ego.cells, self.ego.cells, channels + 1).permute(0, 3, 1, 2)
