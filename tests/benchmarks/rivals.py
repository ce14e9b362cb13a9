"""What public systems do at the same place, in a few plain lines of vectorised torch with our types and results.

Our own wording of their method, from reading their sources; the lines named are where the method stands there.
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
    """OccupancyAnticipation: the egocentric map is padded to the global map's size, and all of it is resampled.

    github.com/facebookresearch/OccupancyAnticipation occant_baselines/models/mapnet.py, class Mapper
    (`_register`/`_spatial_transform`), with spatial_transform_map of occant_utils/common.py.
    """

    def __init__(self, grid: Grid, ego: EgoGrid, layers: int, factor: float) -> None:
        self.grid, self.ego, self.factor = grid, ego, factor
        self.map = torch.zeros(1, layers, grid.rows, grid.columns)
        self.written = torch.zeros(1, layers, grid.rows, grid.columns, dtype=torch.bool)

    def register(self, values: Tensor, mask: Tensor, pose: Pose) -> None:
        """Let one view (1, C, V, V) have its say: the same result as the Mapper with a moving average."""
        where = affine_grid(self._theta(pose), list(self.map.shape), align_corners=True)
        # one more row of the rim, so that bilinear values at the rim are not mixed with the padding's zeros
        padded = pad(pad(values, (1, 1, 1, 1), mode="replicate"), self._margins(1))
        new = grid_sample(padded, where, mode="bilinear", align_corners=True)
        told = grid_sample(pad(mask.float(), self._margins(0)), where, mode="nearest", align_corners=True) > 0
        mixed = torch.where(self.written, self.factor * self.map + (1 - self.factor) * new, new)
        self.map = torch.where(told, mixed, self.map)
        self.written |= told

    def _margins(self, rim: int) -> tuple[int, int, int, int]:
        """So many cells left, right, above and below that the robot comes to lie in the middle of the global map."""
        rows, columns, size = self.grid.rows, self.grid.columns, self.ego.cells
        left, above = columns // 2 - size // 2, rows // 2 - (size - 1)
        return left - rim, columns - left - size - rim, above - rim, rows - above - size - rim

    def _theta(self, pose: Pose) -> Tensor:
        """From places in the global map to places in the padded one, both -1 to 1 from first to last cell."""
        rows, columns = self.grid.rows, self.grid.columns
        row = rows - 0.5 - (pose.y - self.grid.origin[1]) / self.grid.resolution
        column = (pose.x - self.grid.origin[0]) / self.grid.resolution - 0.5
        middle = (columns - 1) / 2, (rows - 1) / 2
        sin, cos = np.sin(pose.theta), np.cos(pose.theta)
        # from (column, row) of the global map, about the robot, to (column, row) of the padded one, about its middle
        turn = np.array([[sin, cos], [-cos, sin]])
        shift = turn @ (np.array(middle) - np.array([column, row])) / np.array(middle)
        shift += (np.array([columns // 2, rows // 2]) - np.array(middle)) / np.array(middle)
        return torch.from_numpy(np.column_stack([turn, shift])[None]).float()


class SplattedMapping:
    """SemExp: points splatted into voxels with trilinear weights, summed over heights, then rotated and shifted over
    the full map by two bilinear samplings.

    github.com/devendrachaplot/Object-Goal-Navigation model.py, Semantic_Mapping.forward, with splat_feat_nd of
    envs/utils/depth_utils.py and get_grid of utils/model.py.
    """

    def __init__(self, grid: Grid, ego: EgoGrid, layers: int, heights: int) -> None:
        self.grid, self.ego, self.layers, self.heights = grid, ego, layers, heights
        self.map = torch.zeros(1, layers, grid.rows, grid.columns)

    def register(self, points: Tensor, labels: Tensor, pose: Pose) -> None:
        """Let one view have its say: the cells in which its points lie, the largest value of all views.

        Args:
            points: (N, 3) row, column and height of each, in cells of the egocentric grid.
            labels: (N, C) one-hot categories.
            pose: of the robot.
        """
        rows, columns = self.grid.rows, self.grid.columns
        voxels = self.splat(points, labels)
        view = voxels.sum(-1).clamp(max=1)[None]
        size, left, above = (
            self.ego.cells,
            columns // 2 - self.ego.cells // 2,
            rows // 2 - (self.ego.cells - 1),
        )
        whole = torch.zeros_like(self.map)
        whole[:, :, above : above + size, left : left + size] = view
        sin, cos = float(np.sin(pose.theta)), float(np.cos(pose.theta))
        row = rows - 0.5 - (pose.y - self.grid.origin[1]) / self.grid.resolution
        column = (pose.x - self.grid.origin[0]) / self.grid.resolution - 0.5
        middle = (columns - 1) / 2, (rows - 1) / 2
        turn = torch.tensor([[[sin, cos, 0.0], [-cos, sin, 0.0]]])
        away = (middle[0] - column) / middle[0], (middle[1] - row) / middle[1]
        shift = torch.tensor([[[1.0, 0.0, away[0]], [0.0, 1.0, away[1]]]])
        turned = grid_sample(
            whole, affine_grid(turn, list(whole.shape), align_corners=True), align_corners=True
        )
        moved = grid_sample(
            turned, affine_grid(shift, list(whole.shape), align_corners=True), align_corners=True
        )
        self.map = torch.maximum(self.map, moved)

    def splat(self, points: Tensor, labels: Tensor) -> Tensor:
        """Voxels (C, V, V, heights) with the points' labels, each shared out to the eight around it."""
        shape = torch.tensor([self.ego.cells, self.ego.cells, self.heights])
        flat = torch.zeros(self.layers, int(shape.prod()))
        low = points.floor()
        for corner in torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3):
            place = low + corner
            weight = (1 - (points - place).abs()).prod(dim=1)
            inside = ((place >= 0) & (place < shape)).all(dim=1)
            cell = (place[:, 0] * shape[1] + place[:, 1]) * shape[2] + place[:, 2]
            index = torch.where(inside, cell, torch.zeros_like(cell)).long()
            flat.index_add_(1, index, (labels * (weight * inside)[:, None]).T)
        return flat.view(self.layers, *shape.tolist())


def points_in_cells(depth: Tensor, lens: Camera, ego: EgoGrid) -> Tensor:
    """Row, column and height of each pixel's return (N, 3), in cells of the egocentric grid and voxels of 5 cm."""
    centre_u, centre_v = lens.principal_point
    right = (torch.arange(lens.width) + 0.5 - centre_u) / lens.focal_length * depth
    down = (torch.arange(lens.height)[:, None] + 0.5 - centre_v) / lens.focal_length * depth
    to_robot = torch.from_numpy(lens.to_robot()).float()
    robot = torch.stack([right, down, depth], dim=-1).view(-1, 3) @ to_robot[:3, :3].T + to_robot[:3, 3]
    forward, left, up = robot.unbind(dim=1)
    row, column = ego.cells - 1 - forward / ego.resolution, ego.cells // 2 - left / ego.resolution
    return torch.stack([row, column, up / VOXEL], dim=1)


def categories_of(points: Tensor, depth: Tensor, labels: Tensor, layers: int, room: Band) -> Tensor:
    """Categories of the returns between floor and ceiling, one column each; `points` as `points_in_cells` gives."""
    height = points[:, 2] * VOXEL
    counts = (depth.view(-1) > 0) & (height >= room.low) & (height <= room.high)
    return ((labels.view(-1, 1) == torch.arange(1, layers + 1)) & counts[:, None]).float()
