"""Methods of public systems, re-implemented in vectorised torch with our types and results.

The docstrings refer to the original sources.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample, pad

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band

VOXEL = 0.05
"""Height of SemExp's voxels, metres."""


class PaddedRegistration:
    """OccupancyAnticipation: pad the egocentric map to the size of the global map and resample all of it.

    github.com/facebookresearch/OccupancyAnticipation occant_baselines/models/mapnet.py, class Mapper
    (`_register`/`_spatial_transform`), with spatial_transform_map of occant_utils/common.py.
    """

    def __init__(self, grid: Grid, ego: EgoGrid, layers: int, factor: float) -> None:
        self.grid, self.ego, self.factor = grid, ego, factor
        self.map = torch.zeros(1, layers, grid.rows, grid.columns)
        self.written = torch.zeros(1, layers, grid.rows, grid.columns, dtype=torch.bool)

    def register(self, values: Tensor, mask: Tensor, pose: Pose) -> None:
        """Fuse one view (1, C, V, V); the result is that of the Mapper with a moving average."""
        where = affine_grid(self._theta(pose), list(self.map.shape), align_corners=True)
        # one more cell at the border, so that bilinear values at the border do not include the zeros of the padding
        padded = pad(pad(values, (1, 1, 1, 1), mode="replicate"), self._margins(1))
        new = grid_sample(padded, where, mode="bilinear", align_corners=True)
        observed = (
            grid_sample(pad(mask.float(), self._margins(0)), where, mode="nearest", align_corners=True) > 0
        )
        mixed = torch.where(self.written, self.factor * self.map + (1 - self.factor) * new, new)
        self.map = torch.where(observed, mixed, self.map)
        self.written |= observed

    def _margins(self, border: int) -> tuple[int, int, int, int]:
        """Return the padding (left, right, above, below) that centres the robot in the global map, cells."""
        rows, columns, size = self.grid.rows, self.grid.columns, self.ego.cells
        left, above = columns // 2 - size // 2, rows // 2 - (size - 1)
        return left - border, columns - left - size - border, above - border, rows - above - size - border

    def _theta(self, pose: Pose) -> Tensor:
        """Return the transform of normalised coordinates (-1 to 1) of the global map to those of the padded map."""
        rows, columns = self.grid.rows, self.grid.columns
        row = rows - 0.5 - (pose.y - self.grid.origin[1]) / self.grid.resolution
        column = (pose.x - self.grid.origin[0]) / self.grid.resolution - 0.5
        middle = (columns - 1) / 2, (rows - 1) / 2
        sin, cos = np.sin(pose.theta), np.cos(pose.theta)
        # (column, row) from the robot in the global map to (column, row) from the middle of the padded map
        rotation = np.array([[sin, cos], [-cos, sin]])
        shift = rotation @ (np.array(middle) - np.array([column, row])) / np.array(middle)
        shift += (np.array([columns // 2, rows // 2]) - np.array(middle)) / np.array(middle)
        return torch.from_numpy(np.column_stack([rotation, shift])[None]).float()


class SplattedMapping:
    """SemExp: splat points into voxels with trilinear weights, sum over heights, and move the map in two samplings.

    github.com/devendrachaplot/Object-Goal-Navigation model.py, Semantic_Mapping.forward, with splat_feat_nd of
    envs/utils/depth_utils.py and get_grid of utils/model.py.
    """

    def __init__(self, grid: Grid, ego: EgoGrid, layers: int, heights: int) -> None:
        self.grid, self.ego, self.layers, self.heights = grid, ego, layers, heights
        self.map = torch.zeros(1, layers, grid.rows, grid.columns)

    def register(self, points: Tensor, labels: Tensor, pose: Pose) -> None:
        """Fuse the points of one view with the maximum.

        Args:
            points: row, column and height of the points (N, 3), in cells of the egocentric grid and voxels.
            labels: one-hot categories (N, C).
            pose: pose of the robot.
        """
        rows, columns = self.grid.rows, self.grid.columns
        voxels = self.splat(points, labels)
        view = voxels.sum(-1).clamp(max=1)[None]
        size, left, above = (
            self.ego.cells,
            columns // 2 - self.ego.cells // 2,
            rows // 2 - (self.ego.cells - 1),
        )
        full = torch.zeros_like(self.map)
        full[:, :, above : above + size, left : left + size] = view
        sin, cos = float(np.sin(pose.theta)), float(np.cos(pose.theta))
        row = rows - 0.5 - (pose.y - self.grid.origin[1]) / self.grid.resolution
        column = (pose.x - self.grid.origin[0]) / self.grid.resolution - 0.5
        middle = (columns - 1) / 2, (rows - 1) / 2
        rotation = torch.tensor([[[sin, cos, 0.0], [-cos, sin, 0.0]]])
        offset = (middle[0] - column) / middle[0], (middle[1] - row) / middle[1]
        shift = torch.tensor([[[1.0, 0.0, offset[0]], [0.0, 1.0, offset[1]]]])
        rotated = grid_sample(
            full, affine_grid(rotation, list(full.shape), align_corners=True), align_corners=True
        )
        shifted = grid_sample(
            rotated, affine_grid(shift, list(full.shape), align_corners=True), align_corners=True
        )
        self.map = torch.maximum(self.map, shifted)

    def splat(self, points: Tensor, labels: Tensor) -> Tensor:
        """Return voxels (C, V, V, heights) with the labels of points, distributed over their eight neighbours."""
        shape = torch.tensor([self.ego.cells, self.ego.cells, self.heights])
        flat = torch.zeros(self.layers, int(shape.prod()))
        low = points.floor()
        for corner in torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3):
            voxel = low + corner
            weight = (1 - (points - voxel).abs()).prod(dim=1)
            inside = ((voxel >= 0) & (voxel < shape)).all(dim=1)
            cell = (voxel[:, 0] * shape[1] + voxel[:, 1]) * shape[2] + voxel[:, 2]
            index = torch.where(inside, cell, torch.zeros_like(cell)).long()
            flat.index_add_(1, index, (labels * (weight * inside)[:, None]).T)
        return flat.view(self.layers, *shape.tolist())


def points_in_cells(depth: Tensor, lens: Camera, ego: EgoGrid) -> Tensor:
    """Return row, column and height of each pixel (N, 3), in cells of the egocentric grid and voxels of 5 cm."""
    centre_u, centre_v = lens.principal_point
    right = (torch.arange(lens.width) + 0.5 - centre_u) / lens.focal_length * depth
    down = (torch.arange(lens.height)[:, None] + 0.5 - centre_v) / lens.focal_length * depth
    to_robot = torch.from_numpy(lens.to_robot()).float()
    robot = torch.stack([right, down, depth], dim=-1).view(-1, 3) @ to_robot[:3, :3].T + to_robot[:3, 3]
    forward, left, up = robot.unbind(dim=1)
    row, column = ego.cells - 1 - forward / ego.resolution, ego.cells // 2 - left / ego.resolution
    return torch.stack([row, column, up / VOXEL], dim=1)


def categories_of(points: Tensor, depth: Tensor, labels: Tensor, layers: int, room: Band) -> Tensor:
    """Return one-hot categories of the points of `points_in_cells` between floor and ceiling."""
    height = points[:, 2] * VOXEL
    counts = (depth.view(-1) > 0) & (height >= room.low) & (height <= room.high)
    return ((labels.view(-1, 1) == torch.arange(1, layers + 1)) & counts[:, None]).float()
