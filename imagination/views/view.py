"""One view: the sensor image at a pose, its projection and the ground truth around it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from imagination.geometry.pose import Pose


class View(NamedTuple):
    """What one look gives, the truth around it included.

    Attributes:
        pose: of the robot.
        rgb, depth: the sensor's image; depth in metres along the optical axis, 0 where nothing returned.
        categories: ground-truth segmentation of the image; 0 none, else the category's row + 1.
        occupied, seen: egocentric maps projected from depth.
        object: V_object, the egocentric crop of M_gt, one layer for each row of the category table.
    """

    pose: Pose
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    categories: UInt8[np.ndarray, "h w"]
    occupied: Bool[np.ndarray, "v v"]
    seen: Bool[np.ndarray, "v v"]
    object: Bool[np.ndarray, "c v v"]
