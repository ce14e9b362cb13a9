"""Real RGB-D cameras: intrinsics, distortion and mounting."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose
from imagination.utils.errors import UserError, check_range


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with distortion, as OpenCV and ROS state it: the **centre** of the first pixel is at (0, 0).

    Attributes:
        width, height: pixels.
        fx, fy: focal lengths, pixels. A negative one, as some synthetic data sets have it, means that this axis of
            the camera's frame runs against the image's.
        cx, cy: principal point, pixels.
        distortion: OpenCV's coefficients (ROS' plumb_bob and rational_polynomial), none if empty.
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
                f"intrinsics.distortion: got {self.distortion}, expected none or 4, 5, 8, 12 or 14 finite numbers"
            )

    @classmethod
    def of(cls, camera: Camera) -> "Intrinsics":
        """Those of an ideal camera, whose first pixel's centre is at (0.5, 0.5)."""
        focal, (x, y) = camera.focal_length, camera.principal_point
        return cls(camera.width, camera.height, focal, focal, x - 0.5, y - 0.5)

    @property
    def matrix(self) -> Float64[np.ndarray, "3 3"]:
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def fields_of_view(self) -> tuple[float, float]:
        """Horizontal and vertical, radians."""
        axes = (self.fx, self.cx, self.width), (self.fy, self.cy, self.height)
        horizontal, vertical = (
            float(np.arctan((centre + 0.5) / abs(focal)) + np.arctan((size - 0.5 - centre) / abs(focal)))
            for focal, centre, size in axes
        )
        return horizontal, vertical

    def scaled(self, factor: float) -> "Intrinsics":
        """Those of the image brought to `factor` times its size."""
        width, height = round(self.width * factor), round(self.height * factor)
        x, y = width / self.width, height / self.height
        middle = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=middle[0], cy=middle[1]
        )


@dataclass(frozen=True)
class RgbdCamera:
    """A robot's camera: colour and depth, and where it sits.

    Attributes:
        colour: intrinsics of the colour image.
        depth: of the depth image; None if depth is already registered to colour, pixel by pixel.
        depth_to_colour: transform from the depth camera's optical frame to the colour camera's.
        mount_height, pitch, roll: of the colour camera above the robot, as in `Camera`; not used where poses are the
            camera's own, in six degrees of freedom.
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
        """An ideal camera as a robot's."""
        mount = camera.mount_height, camera.pitch, camera.roll
        return cls(Intrinsics.of(camera), None, np.eye(4), *mount)

    @property
    def depth_intrinsics(self) -> Intrinsics:
        return self.depth or self.colour

    def to_world(self, pose: Pose, floor_height: float = 0.0) -> Float64[np.ndarray, "4 4"]:
        """Transform from the colour camera's optical frame to the world's, for the robot at `pose`."""
        at = Camera(8, 8, 1.0, self.mount_height, self.pitch, self.roll)  # only where it sits matters
        return at.to_world(pose, floor_height)


class Placement(NamedTuple):
    """A camera's pose in six degrees of freedom, as the robot's planar pose and how the camera sits above it.

    Attributes:
        pose: of the robot, under the optical centre, heading where the camera looks.
        mount_height: metres above the floor.
        pitch, roll: radians, as in `Camera`.
    """

    pose: Pose
    mount_height: float
    pitch: float
    roll: float

    @classmethod
    def of(cls, camera_to_world: Float64[np.ndarray, "4 4"], floor_height: float = 0.0) -> "Placement":
        """Take a transform from the optical frame to the world's apart.

        Raises:
            UserError: if it is no rigid transform.
        """
        check_transform("camera_to_world", camera_to_world)
        right, ahead = camera_to_world[:3, 0], camera_to_world[:3, 2]
        heading = float(np.arctan2(ahead[1], ahead[0]))
        pitch = float(np.arcsin(np.clip(-ahead[2], -1.0, 1.0)))
        # roll turns the image's x axis out of the horizontal, about the optical axis
        level = np.array([np.sin(heading), -np.cos(heading), 0.0])
        roll = float(np.arctan2(np.cross(level, right) @ ahead, level @ right))
        x, y, z = camera_to_world[:3, 3].tolist()
        return cls(Pose(x, y, heading), z - floor_height, pitch, roll)


def check_transform(name: str, transform: np.ndarray) -> None:
    """Refuse what is no rigid transform.

    Raises:
        UserError: on a wrong shape, numbers that are not finite, or a rotation that is none.
    """
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise UserError(f"{name}: got {transform.tolist()}, expected 4 x 4 finite numbers")
    turn = transform[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise UserError(
            f"{name}: got the rotation {turn.tolist()}, expected a proper one (no scale, no mirror)"
        )
