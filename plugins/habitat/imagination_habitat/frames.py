"""Between Habitat's frames and ours, without the simulator.

Habitat's world has y up, ours z: (x, y, z) there is (x, -z, y) here. Its camera looks along -z with y up, ours along
z with y down.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from imagination.geometry.grid import Grid
from imagination.scenes.scene import OrientedBox

TO_OURS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns Habitat's world into ours; its transpose turns ours into Habitat's."""
FLIP = np.diag([1.0, -1.0, -1.0])
"""Between the axes of the two cameras; its own inverse."""

Quaternion = tuple[float, float, float, float]
"""w, x, y, z."""


def to_ours(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points of Habitat's world in ours, metres."""
    return np.asarray(points @ TO_OURS.T)


def to_habitat(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points of our world in Habitat's, metres."""
    return np.asarray(points @ TO_OURS)


def camera_state(camera_to_world: Float[np.ndarray, "4 4"]) -> tuple[Float[np.ndarray, "3"], Quaternion]:
    """Place and rotation in Habitat's world of a camera whose pose in ours is known (optical frame to world)."""
    rotation = TO_OURS.T @ camera_to_world[:3, :3] @ FLIP
    return to_habitat(camera_to_world[:3, 3]), quaternion(rotation)


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Quaternion:
    """A rotation as a unit quaternion with w >= 0, from the largest of its four components (Shepperd)."""
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


def rotation_of(turn: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """The matrix of a unit quaternion x, y, z, w, as Habitat's boxes have it."""
    x, y, z, w = turn
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def upright(centre: Sequence[float], half_extents: Sequence[float], turn: Sequence[float]) -> OrientedBox:
    """The upright box around one of Habitat's oriented boxes.

    Args:
        centre, half_extents: in Habitat's world and in the box's own axes, metres.
        turn: quaternion x, y, z, w from the box's axes to Habitat's world.
    """
    axes = TO_OURS @ rotation_of(turn)  # columns: the box's axes in our world
    # the axis that lies most level gives the yaw
    lying = int(np.argmin(np.abs(axes[2])))
    yaw = float(np.arctan2(axes[1, lying], axes[0, lying]))
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    offsets = (signs * np.asarray(half_extents)) @ axes.T
    along = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    reach = np.abs(offsets[:, :2] @ along).max(axis=0)
    x, y, z = to_ours(np.asarray(centre, np.float64)).tolist()
    width, depth, height = (float(2 * value) for value in (*reach, np.abs(offsets[:, 2]).max()))
    return OrientedBox((x, y, z), (width, depth, height), yaw)


def free_grid(
    view: Bool[np.ndarray, "h w"], lower: Sequence[float], metres_per_pixel: float
) -> tuple[Grid, Bool[np.ndarray, "h w"]]:
    """Habitat's top-down view as our grid: its rows run along +z from `lower`, which is our -y; its columns along x.

    Args:
        view: True where the agent may be.
        lower: the navmesh's lower bound x, y, z.
        metres_per_pixel: side of a cell.
    """
    rows, columns = view.shape
    origin = float(lower[0]), float(-(lower[2] + rows * metres_per_pixel))
    return Grid(metres_per_pixel, rows, columns, origin), view
