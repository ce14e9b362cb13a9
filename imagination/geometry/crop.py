"""Affine map from egocentric to global cells, and egocentric crops of global maps (docs/concepts/conventions.md)."""

import numpy as np
from jaxtyping import Bool, Float64

from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.utils.errors import UserError
from imagination.utils.jit import compiled


def ego_to_grid(ego: EgoGrid, grid: Grid, pose: Pose) -> Float64[np.ndarray, "2 3"]:
    """Return the affine map from egocentric (row, column, 1) to global (row, column); integers are cell centres.

    Raises:
        UserError: if the pose is not finite.
    """
    if not np.isfinite(pose).all():
        raise UserError(f"pose: got {tuple(pose)}, expected finite x, y in metres and theta in radians")
    scale = ego.resolution / grid.resolution
    cos, sin = scale * np.cos(pose.theta), scale * np.sin(pose.theta)
    rotation = np.array([[sin, cos], [-cos, sin]])  # the identity for a heading along +y: both maps point up
    robot = [
        grid.rows - 0.5 - (pose.y - grid.origin[1]) / grid.resolution,
        (pose.x - grid.origin[0]) / grid.resolution - 0.5,
    ]
    return np.column_stack([rotation, robot - rotation @ [ego.cells - 1, ego.cells // 2]])


def crop(
    layer: Bool[np.ndarray, "*b h w"], grid: Grid, pose: Pose, ego: EgoGrid
) -> Bool[np.ndarray, "*b v v"]:
    """Crop the egocentric window from global maps: each cell takes the value of the global cell at its centre.

    Args:
        layer: one global map, or several with leading axes.
        grid: grid of the global maps.
        pose: pose of the robot.
        ego: grid of the crop; cells outside the global map are False.

    Raises:
        UserError: if the pose is not finite, or the shape of the maps differs from the grid.
    """
    if layer.shape[-2:] != grid.shape:
        raise UserError(
            f"map to crop: got shape {layer.shape[-2:]}, expected {grid.shape}, the shape of the grid"
        )
    out = np.zeros((*layer.shape[:-2], ego.cells, ego.cells), np.bool_)
    _pull(layer.reshape(-1, *grid.shape), ego_to_grid(ego, grid, pose), out.reshape(-1, ego.cells, ego.cells))
    return out


@compiled
def _pull(
    layers: Bool[np.ndarray, "c h w"], to_grid: Float64[np.ndarray, "2 3"], out: Bool[np.ndarray, "c v v"]
) -> None:
    rows, columns = layers.shape[1:]
    for r in range(out.shape[1]):
        for c in range(out.shape[2]):
            row = np.floor(to_grid[0, 0] * r + to_grid[0, 1] * c + to_grid[0, 2] + 0.5)
            column = np.floor(to_grid[1, 0] * r + to_grid[1, 1] * c + to_grid[1, 2] + 0.5)
            if 0 <= row < rows and 0 <= column < columns:
                for k in range(out.shape[0]):
                    out[k, r, c] = layers[k, int(row), int(column)]
