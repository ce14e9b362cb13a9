"""Real RGB-D cameras: intrinsics, distortion and extrinsics."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose
from imagination.utils.errors import UserError, check_range


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a pinhole camera with distortion, as in OpenCV and ROS: the first pixel's **centre** is at (0, 0).

    Attributes:
        width, height: image size, pixels.
        fx, fy: focal lengths, pixels. A negative value, as in some synthetic data sets, means that this axis of the
            camera frame is opposite to that of the image.
        cx, cy: principal point, pixels.
        distortion: OpenCV's distortion coefficients (plumb_bob, rational_polynomial in ROS); empty if undistorted.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_range("intrinsics.width", self.width, 8, 8192, "pixels")
        check_range("intrinsics.height", self.height, 8, 8192, "pixels")
        for name, size in (("fx", self.width), ("fy", self.height)):
            check_range(f"|intrinsics.{name}|", abs(getattr(self, name)), 0.05 * size, 100 * size, "pixels")
        check_range("intrinsics.cx", self.cx, -self.width, 2 * self.width, "pixels")
        check_range("intrinsics.cy", self.cy, -self.height, 2 * self.height, "pixels")
        if len(self.distortion) not in (0, 4, 5, 8, 12, 14) or not np.isfinite(self.distortion).all():
            raise UserError(
                f"intrinsics.distortion: got {self.distortion}, expected 0, 4, 5, 8, 12 or 14 finite numbers"
            )

    @classmethod
    def of(cls, camera: Camera) -> "Intrinsics":
        """Return the intrinsics of an ideal camera, whose first pixel's centre is at (0.5, 0.5)."""
        focal, (x, y) = camera.focal_length, camera.principal_point
        return cls(camera.width, camera.height, focal, focal, x - 0.5, y - 0.5)

    @property
    def matrix(self) -> Float64[np.ndarray, "3 3"]:
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def fields_of_view(self) -> tuple[float, float]:
        """Horizontal and vertical field of view, radians."""
        axes = (self.fx, self.cx, self.width), (self.fy, self.cy, self.height)
        horizontal, vertical = (
            float(np.arctan((centre + 0.5) / abs(focal)) + np.arctan((size - 0.5 - centre) / abs(focal)))
            for focal, centre, size in axes
        )
        return horizontal, vertical

    def scaled(self, factor: float) -> "Intrinsics":
        """Return the intrinsics of the image resized by `factor`."""
        width, height = round(self.width * factor), round(self.height * factor)
        x, y = width / self.width, height / self.height
        centre = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=centre[0], cy=centre[1]
        )


@dataclass(frozen=True)
class RgbdCamera:
    """RGB-D camera of a robot: intrinsics of colour and depth, and extrinsics.

    Attributes:
        colour: intrinsics of the colour image.
        depth: intrinsics of the depth image; None if depth is registered to colour pixel by pixel.
        depth_to_colour: transform from the optical frame of the depth camera to that of the colour camera.
        mount_height, pitch, roll: mounting of the colour camera on the robot, as in `Camera`; not used with camera
            poses in six degrees of freedom.
    """

    colour: Intrinsics
    depth: Intrinsics | None = None
    depth_to_colour: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    mount_height: float = 1.25
    pitch: float = 0.0
    roll: float = 0.0

    def __post_init__(self) -> None:
        check_transform("depth_to_colour", self.depth_to_colour)

    @classmethod
    def of(cls, camera: Camera) -> "RgbdCamera":
        """Return an ideal camera as an RGB-D camera."""
        mount = camera.mount_height, camera.pitch, camera.roll
        return cls(Intrinsics.of(camera), None, np.eye(4), *mount)

    @property
    def depth_intrinsics(self) -> Intrinsics:
        return self.depth or self.colour

    def to_world(self, pose: Pose, floor_height: float = 0.0) -> Float64[np.ndarray, "4 4"]:
        """Return the transform from the optical frame of the colour camera to the world frame for a robot at `pose`."""
        mounting = Camera(8, 8, 1.0, self.mount_height, self.pitch, self.roll)  # the size is not used
        return mounting.to_world(pose, floor_height)


class Placement(NamedTuple):
    """Camera pose in six degrees of freedom as planar pose of the robot and mounting of the camera.

    Attributes:
        pose: pose of the robot, below the optical centre, with the heading of the camera.
        mount_height: height of the optical centre above the floor, metres.
        pitch, roll: pitch and roll angles as in `Camera`, radians.
    """

    pose: Pose
    mount_height: float
    pitch: float
    roll: float

    @classmethod
    def of(cls, camera_to_world: Float64[np.ndarray, "4 4"], floor_height: float = 0.0) -> "Placement":
        """Decompose a transform from the optical frame to the world frame.

        Raises:
            UserError: if the transform is not rigid.
        """
        check_transform("camera_to_world", camera_to_world)
        right, ahead = camera_to_world[:3, 0], camera_to_world[:3, 2]
        heading = float(np.arctan2(ahead[1], ahead[0]))
        pitch = float(np.arcsin(np.clip(-ahead[2], -1.0, 1.0)))
        # roll rotates the image's x axis out of the horizontal plane, about the optical axis
        level = np.array([np.sin(heading), -np.cos(heading), 0.0])
        roll = float(np.arctan2(np.cross(level, right) @ ahead, level @ right))
        x, y, z = camera_to_world[:3, 3].tolist()
        return cls(Pose(x, y, heading), z - floor_height, pitch, roll)


def check_transform(name: str, transform: np.ndarray) -> None:
    """Check that a matrix is a rigid transform.

    Raises:
        UserError: if the shape is wrong, a number is not finite, or the rotation is not proper.
    """
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise UserError(f"{name}: got {transform.tolist()}, expected 4 x 4 finite numbers")
    rotation = transform[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise UserError(
            f"{name}: got the rotation {rotation.tolist()}, expected a proper rotation (no scale, no mirror)"
        )
