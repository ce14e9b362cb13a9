"""The variant that carries image features to the egocentric grid through depth."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, Float16, Int64, UInt8
from torch import Tensor, nn
from torch.nn.functional import interpolate

from imagination.errors import UserError
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.units.backbones import Backbone, Convolution
from imagination.units.encoders import TimmEncoder
from imagination.units.unit import Unit, prediction_head


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
        categories: what to imagine, one map each.
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
    ) -> None:
        super().__init__(categories)
        self.encoder = encoder
        self.reduce = Convolution(encoder.channels, width, kernel=1)
        self.projection = Projection(camera, ego, max_height)
        self.backbone = backbone(in_channels=2 + width + 1, image_channels=0)
        self.head = prediction_head(self.backbone.width, len(categories))
        self.to(memory_format=torch.channels_last)

    def forward(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """Logits of V_object; see `Unit`. The images are of the camera's size."""
        image = interpolate(self.reduce(self.encoder(rgb)), size=depth.shape[-2:], mode="bilinear")
        maps = [occupied.float(), seen.float(), self.projection(image, depth)]
        logits: Tensor = self.head(self.backbone(torch.cat(maps, dim=1)))
        return logits


class Projection(nn.Module):
    """Means over the egocentric grid's cells of what an image shows in them (docs/conventions.md).

    A pixel's return is its ray, scaled by its depth, in the robot's frame; cells are those of `EgoGrid.to_cells`.
    """

    rays: Tensor

    def __init__(self, camera: Camera, ego: EgoGrid, max_height: float) -> None:
        super().__init__()
        self.ego = ego
        self.max_height = max_height
        self.mount_height = camera.mount_height
        self.register_buffer("rays", torch.from_numpy(pixel_rays(camera)), persistent=False)

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
        if depth.shape[-2:] != self.rays.shape[-2:]:
            got, expected = tuple(depth.shape[-2:]), tuple(self.rays.shape[-2:])
            raise UserError(
                f"depth: got images of {got} pixels, expected the camera's {expected} (see conf, camera)"
            )
        batch, channels = image.shape[:2]
        forward, left, up = (depth.float() * self.rays).unbind(1)  # in single precision under autocast too
        height = up + self.mount_height
        cells = self._cells(forward, left, (depth[:, 0] > 0) & (height <= self.max_height))
        values = torch.cat([image.float(), height[:, None], torch.ones_like(height)[:, None]], dim=1)
        rows = values.permute(0, 2, 3, 1).reshape(-1, channels + 2)
        # one row a cell, and a last one for the returns that lie in none
        sums = rows.new_zeros(batch * self.ego.cells**2 + 1, channels + 2)
        sums = sums.scatter_add(0, cells.reshape(-1, 1).expand_as(rows), rows)[:-1]
        means = sums[:, :-1] / sums[:, -1:].clamp(min=1)
        return means.view(batch, self.ego.cells, self.ego.cells, channels + 1).permute(0, 3, 1, 2)

    def _cells(self, forward: Tensor, left: Tensor, valid: Tensor) -> Int64[Tensor, "b h w"]:
        """Index of each return's cell among those of the whole batch; one past the last for those in none."""
        size = self.ego.cells
        row = torch.floor(size - 0.5 - forward / self.ego.resolution).long()
        column = torch.floor(size // 2 + 0.5 - left / self.ego.resolution).long()
        inside = valid & (row >= 0) & (row < size) & (column >= 0) & (column < size)
        first = torch.arange(len(forward), device=forward.device).view(-1, 1, 1) * size**2
        return torch.where(inside, first + row * size + column, len(forward) * size**2)


def pixel_rays(camera: Camera) -> Float[np.ndarray, "3 h w"]:
    """What one metre of depth is in the robot's frame (forward, left, up from the camera) at each pixel's centre."""
    centre_u, centre_v = camera.principal_point
    u, v = np.meshgrid(np.arange(camera.width) + 0.5 - centre_u, np.arange(camera.height) + 0.5 - centre_v)
    optical = np.stack([u / camera.focal_length, v / camera.focal_length, np.ones_like(u)])
    return np.tensordot(camera.to_robot()[:3, :3], optical, axes=1).astype(np.float32)
