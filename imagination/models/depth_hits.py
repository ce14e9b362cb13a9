"""Depth returns located in the egocentric grid, for units that project depth themselves."""

import numpy as np
import torch
from jaxtyping import Float, Float16, Int64
from torch import Tensor, nn

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.utils.errors import UserError


class DepthHits(nn.Module):
    """Projection of depth returns into the egocentric grid: ray times depth, in the robot frame.

    docs/concepts/conventions.md defines the frames.

    Args:
        camera: camera of the depth images.
        ego: grid of the maps, indexed as by `EgoGrid.to_cells`.
    """

    rays: Tensor
    mount_height: Tensor

    def __init__(self, camera: Camera, ego: EgoGrid) -> None:
        super().__init__()
        self.ego = ego
        self.register_buffer("rays", torch.from_numpy(pixel_rays(camera)), persistent=False)
        # a buffer, so that an exported unit can use the mount height of another robot
        self.register_buffer("mount_height", torch.tensor(camera.mount_height), persistent=False)

    def forward(
        self, depth: Float16[Tensor, "b 1 h w"], low: float, high: float
    ) -> tuple[Int64[Tensor, "b h w"], Float[Tensor, "b h w"]]:
        """Return the cell index of each return and its height above the floor, metres.

        Cells are indexed row by row through the maps of the whole batch. Pixels without a return, and returns outside
        the grid or the range of heights, get the index one past the last cell.

        Args:
            depth: depth images, metres; 0 without a return.
            low: lowest height that counts, metres.
            high: greatest height that counts, metres.

        Raises:
            UserError: if the images do not have the camera's size.
        """
        if depth.shape[-2:] != self.rays.shape[-2:]:
            got, expected = tuple(depth.shape[-2:]), tuple(self.rays.shape[-2:])
            raise UserError(
                f"depth: got images of {got} pixels, expected the camera's {expected}; change camera in the config"
            )
        forward, left, up = (depth.float() * self.rays).unbind(1)  # single precision even under autocast
        height = up + self.mount_height
        size = self.ego.cells
        row = torch.floor(size - 0.5 - forward / self.ego.resolution).long()
        column = torch.floor(size // 2 + 0.5 - left / self.ego.resolution).long()
        inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
        valid = inside & (depth[:, 0] > 0) & (height >= low) & (height <= high)
        first = torch.arange(len(depth), device=depth.device).view(-1, 1, 1) * size**2
        return torch.where(valid, first + row * size + column, len(depth) * size**2), height


def pixel_rays(camera: Camera) -> Float[np.ndarray, "3 h w"]:
    """Return the ray through each pixel's centre per metre of depth, in the robot frame (forward, left, up)."""
    centre_u, centre_v = camera.principal_point
    u, v = np.meshgrid(np.arange(camera.width) + 0.5 - centre_u, np.arange(camera.height) + 0.5 - centre_v)
    optical = np.stack([u / camera.focal_length, v / camera.focal_length, np.ones_like(u)])
    return np.tensordot(camera.to_robot()[:3, :3], optical, axes=1).astype(np.float32)
