"""View: the sensor image at a pose, its projection and the ground truth around the robot."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from imagination.geometry.pose import Pose


class View(NamedTuple):
    """One view with the ground truth around the robot.

    Attributes:
        pose: pose of the robot.
        rgb, depth: sensor image; depth along the optical axis in metres, 0 where there is no return.
        categories: ground-truth segmentation of the image; 0 is background, k is row k - 1 of the category table.
        occupied, seen: egocentric maps projected from depth.
        object: V_object, the egocentric crop of M_gt, with one layer for each row of the category table.
    """

    pose: Pose
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    categories: UInt8[np.ndarray, "h w"]
    occupied: Bool[np.ndarray, "v v"]
    seen: Bool[np.ndarray, "v v"]
    object: Bool[np.ndarray, "c v v"]
