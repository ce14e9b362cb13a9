"""Egocentric depth projection split into bands of height."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Float16
from torch import Tensor, nn

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.models.depth_hits import DepthHits
from imagination.utils.errors import UserError, check_range


class HeightBands(nn.Module):
    """Egocentric depth projection by height: one map per band, of the cells with a return in it; see `ImaginationUnit`.

    Args:
        camera: camera of the depth images.
        ego: grid of the maps.
        heights: bounds of the bands above the floor, ascending, metres; fewer than two give no band.
        jitter: largest relative change of the heights in training, drawn for each view.

    Raises:
        UserError: if the heights do not ascend or the jitter is out of range.
    """

    def __init__(self, camera: Camera, ego: EgoGrid, heights: Sequence[float], jitter: float = 0.0) -> None:
        super().__init__()
        self.jitter = check_range("model.unit.height_jitter", jitter, 0.0, 0.5)
        if list(heights) != sorted(set(heights)):
            raise UserError(f"model.heights: got {list(heights)}, expected ascending heights in metres")
        self.heights = list(heights)
        self.count = max(len(heights) - 1, 0)
        self.ego = ego
        self.depth_hits = DepthHits(camera, ego)

    def forward(self, depth: Float16[Tensor, "b 1 h w"]) -> Float[Tensor, "b n v v"]:
        """Return 1 in cells with a return between two successive heights, the upper one included, else 0."""
        size, count = self.ego.cells, self.count
        if not count:
            return depth.new_zeros(len(depth), 0, size, size, dtype=torch.float32)
        cells, height = self.depth_hits(depth, *self._bounds())
        if self.training and self.jitter:
            factor = 1 + self.jitter * (2 * torch.rand(len(height), 1, 1, device=height.device) - 1)
            height = height * factor
            inside = (height >= self.heights[0]) & (height <= self.heights[-1])
            cells = torch.where(inside, cells, len(depth) * size**2)
        band = torch.bucketize(height, height.new_tensor(self.heights[1:-1]))
        # the last row collects the pixels without a return
        marked = height.new_zeros((len(depth) * size**2 + 1) * count)
        marked[(cells * count + band).reshape(-1)] = 1
        maps: Tensor = marked.view(-1, count)[:-1].view(-1, size, size, count).permute(0, 3, 1, 2)
        return maps

    def _bounds(self) -> tuple[float, float]:
        """Return the lowest and the greatest height that can fall into a band, before jitter."""
        jitter = self.jitter if self.training else 0.0
        return self.heights[0] / (1 + jitter), self.heights[-1] / (1 - jitter)
