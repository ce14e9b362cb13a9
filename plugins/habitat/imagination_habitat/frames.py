"""Conversion between the frames of Habitat and of this project; it needs no simulator.

Habitat's world has y up, this project z: (x, y, z) of Habitat is (x, -z, y) here. Habitat's camera faces -z with y up,
the optical frame here faces z with y down.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from imagination.geometry.grid import Grid
from imagination.scenes.scene import OrientedBox

FROM_HABITAT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from Habitat's world to ours; its transpose is the inverse."""
FLIP = np.diag([1.0, -1.0, -1.0])
"""Rotation between the camera axes; equal to its inverse."""

Quaternion = tuple[float, float, float, float]
"""Unit quaternion w, x, y, z."""


def from_habitat(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Convert points of Habitat's world to ours, metres."""
    return np.asarray(points @ FROM_HABITAT.T)


def to_habitat(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Convert points of our world to Habitat's, metres."""
    return np.asarray(points @ FROM_HABITAT)


def camera_state(camera_to_world: Float[np.ndarray, "4 4"]) -> tuple[Float[np.ndarray, "3"], Quaternion]:
    """Convert a camera pose (optical frame to our world) to a position and rotation in Habitat's world."""
    rotation = FROM_HABITAT.T @ camera_to_world[:3, :3] @ FLIP
    return to_habitat(camera_to_world[:3, 3]), quaternion(rotation)


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Quaternion:
    """Convert a rotation matrix to a unit quaternion with w >= 0 by Shepperd's method."""
    xx, yy, zz = np.diag(rotation)
    squares = np.array([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz])
    r = rotation
    rows = {
        0: [squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        1: [r[2, 1] - r[1, 2], squares[1], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        2: [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], squares[2], r[1, 2] + r[2, 1]],
        3: [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[3]],
    }
    values = np.array(rows[int(squares.argmax())])
    values = values / np.linalg.norm(values) * (1 if values[0] >= 0 else -1)
    w, x, y, z = values.tolist()
    return w, x, y, z


def rotation_matrix(rotation: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Convert a unit quaternion x, y, z, w, the order of Habitat's boxes, to a matrix."""
    x, y, z, w = rotation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def upright_box(
    centre: Sequence[float], half_extents: Sequence[float], rotation: Sequence[float]
) -> OrientedBox:
    """Return the upright box around an oriented box of Habitat.

    Args:
        centre: centre in Habitat's world, metres.
        half_extents: half sides along the axes of the box, metres.
        rotation: quaternion x, y, z, w from the axes of the box to Habitat's world.
    """
    axes = FROM_HABITAT @ rotation_matrix(rotation)  # columns: axes of the box in our world
    horizontal = int(np.argmin(np.abs(axes[2])))
    yaw = float(np.arctan2(axes[1, horizontal], axes[0, horizontal]))
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    offsets = (signs * np.asarray(half_extents)) @ axes.T
    along = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    reach = np.abs(offsets[:, :2] @ along).max(axis=0)
    x, y, z = from_habitat(np.asarray(centre, np.float64)).tolist()
    width, depth, height = (float(2 * value) for value in (*reach, np.abs(offsets[:, 2]).max()))
    return OrientedBox((x, y, z), (width, depth, height), yaw)


def free_grid(
    view: Bool[np.ndarray, "h w"], lower: Sequence[float], metres_per_pixel: float
) -> tuple[Grid, Bool[np.ndarray, "h w"]]:
    """Convert Habitat's top-down view to a grid in our world.

    Rows of the view run along Habitat's z (our -y) from `lower`, columns along x.

    Args:
        view: mask of the navigable cells.
        lower: lower bound x, y, z of the navmesh, metres.
        metres_per_pixel: side of a cell, metres.
    """
    rows, columns = view.shape
    origin = float(lower[0]), float(-(lower[2] + rows * metres_per_pixel))
    return Grid(metres_per_pixel, rows, columns, origin), view
