"""Pinhole camera of the robot (docs/concepts/conventions.md: optical frame x right, y down, z forward)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from imagination.geometry.pose import Pose
from imagination.utils.errors import check_range


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with square pixels and the principal point at the image centre.

    Attributes:
        width, height: image size, pixels.
        field_of_view: horizontal field of view, radians.
        mount_height: height of the optical centre above the floor, metres.
        pitch: pitch angle, radians; positive tilts the camera down.
        roll: roll angle about the optical axis, radians; positive is clockwise as seen from behind.
    """

    width: int
    height: int
    field_of_view: float
    mount_height: float
    pitch: float = 0.0
    roll: float = 0.0

    def __post_init__(self) -> None:
        check_range("camera.width", self.width, 8, 8192, "pixels")
        check_range("camera.height", self.height, 8, 8192, "pixels")
        check_range("camera.field_of_view", self.field_of_view, 0.1, 3.0, "rad")
        check_range("camera.mount_height", self.mount_height, 0.05, 5.0, "m")
        check_range("camera.pitch", self.pitch, -1.4, 1.4, "rad (positive is down)")
        check_range("camera.roll", self.roll, -np.pi, np.pi, "rad")

    @classmethod
    def from_degrees(
        cls,
        width: int,
        height: int,
        field_of_view: float,
        mount_height: float,
        pitch: float = 0.0,
        roll: float = 0.0,
    ) -> "Camera":
        """Return a camera from angles in degrees; the other arguments are those of the class."""
        check_range("camera.field_of_view", field_of_view, 6, 170, "degrees")
        check_range("camera.pitch", pitch, -80, 80, "degrees (positive is down)")
        check_range("camera.roll", roll, -180, 180, "degrees")
        fov, pitch_angle, roll_angle = np.deg2rad([field_of_view, pitch, roll]).tolist()
        return cls(width, height, fov, mount_height, pitch_angle, roll_angle)

    @property
    def focal_length(self) -> float:
        """Focal length in pixels."""
        return 0.5 * self.width / float(np.tan(self.field_of_view / 2))

    @property
    def principal_point(self) -> tuple[float, float]:
        """Pixel coordinates (u, v) of the optical axis."""
        return self.width / 2, self.height / 2

    def to_robot(self) -> Float[np.ndarray, "4 4"]:
        """Return the transform from the optical frame to the robot frame (x forward, y left, z up; on the floor)."""
        optical_to_level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        cos_p, sin_p = np.cos(self.pitch), np.sin(self.pitch)
        pitch = np.array([[cos_p, 0.0, sin_p], [0.0, 1.0, 0.0], [-sin_p, 0.0, cos_p]])
        cos_r, sin_r = np.cos(self.roll), np.sin(self.roll)
        roll = np.array([[1.0, 0.0, 0.0], [0.0, cos_r, -sin_r], [0.0, sin_r, cos_r]])
        transform = np.eye(4)
        transform[:3, :3] = pitch @ roll @ optical_to_level
        transform[2, 3] = self.mount_height
        return transform

    def to_world(self, pose: Pose, floor_height: float = 0.0) -> Float[np.ndarray, "4 4"]:
        """Return the transform from the optical frame to the world frame, for a robot at `pose`."""
        robot_to_world = np.eye(4)
        planar = pose.matrix()
        robot_to_world[:2, :2], robot_to_world[:2, 3] = planar[:2, :2], planar[:2, 2]
        robot_to_world[2, 3] = floor_height
        transform: np.ndarray = robot_to_world @ self.to_robot()
        return transform
