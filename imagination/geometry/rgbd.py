"""Real cameras, and their images as the camera that a unit was trained with would have taken them.

A unit knows one ideal camera (`Camera`). A robot's has a focal length for each axis, a principal point, distortion, and
it is tilted; its depth may come from a second one beside it. All that the network sees is brought into the ideal camera
at the same place: one lookup for each pixel. What remains is the height, which the projection takes as it is.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from imagination.compiled import compiled
from imagination.errors import UserError, check_range
from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose

WIDEST = 10.0
"""Of a ray's distance from the optical axis, at distance 1: 84 degrees."""

SAME = 1e-6
"""Cameras whose rays differ by less than this many radians, or pixels of focal length, are one."""


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


class Alignment:
    """Brings a robot's images into an ideal camera at the same place.

    Args:
        camera: the robot's.
        target: the ideal one. Its mount height does not matter.
    """

    def __init__(self, camera: RgbdCamera, target: Camera) -> None:
        self.camera, self.target = camera, target
        # fewer colour pixels than the target's are interpolated, more are averaged before
        self._shrink = min(1.0, target.focal_length / abs(camera.colour.fx))
        colour = camera.colour.scaled(self._shrink) if self._shrink < 1 else camera.colour
        self._colour = colour
        self._is_target = camera.depth is None and _near(camera.colour, Intrinsics.of(target))
        self._beside = not np.allclose(camera.depth_to_colour, np.eye(4), atol=1e-9)
        if self._beside:
            # returns that lie closer than half a pixel of the target tell nothing more
            self._stride = max(1, int(abs(camera.depth_intrinsics.fx) / (2 * target.focal_length)))
            self._depth_rays = _rays(camera.depth_intrinsics, self._stride)
        self._turn: Float64[np.ndarray, "3 3"] | None = None  # that the lookups below were made for

    def __call__(
        self,
        rgb: UInt8[np.ndarray, "h w 3"],
        depth: Float32[np.ndarray, "k l"],
        turn: Float64[np.ndarray, "3 3"],
    ) -> tuple[UInt8[np.ndarray, "p q 3"], Float32[np.ndarray, "p q"]]:
        """Colour and depth as the ideal camera would have taken them; black and 0 where the robot's did not look.

        Args:
            rgb: colour.
            depth: metres along the depth camera's axis, 0 where nothing returned.
            turn: rotation from the colour camera's optical frame to the ideal one's.

        Raises:
            UserError: if the images are not of the camera's sizes.
        """
        for name, image, size in (
            ("rgb", rgb, self.camera.colour),
            ("depth", depth, self.camera.depth_intrinsics),
        ):
            if image.shape[:2] != (size.height, size.width):
                raise UserError(
                    f"{name}: got {image.shape[1]} x {image.shape[0]} pixels, expected "
                    f"{size.width} x {size.height} as the camera's intrinsics say; give those of this size"
                )
        if self._is_target and np.allclose(turn, np.eye(3), atol=SAME):
            return rgb, depth
        if self._turn is None or not np.allclose(turn, self._turn, rtol=0, atol=SAME):
            self._prepare(turn)
        if self._shrink < 1:
            smaller = self._colour.width, self._colour.height
            rgb = cv2.resize(rgb, smaller, interpolation=cv2.INTER_AREA)
        colour = cv2.remap(rgb, *self._colour_lookup, cv2.INTER_LINEAR)
        if not self._beside:
            seen = cv2.remap(depth, *self._depth_lookup, cv2.INTER_NEAREST)
            return colour, seen * self._depth_scale
        out = np.zeros((self.target.height, self.target.width), np.float32)
        _reproject(
            depth[:: self._stride, :: self._stride],
            self._depth_rays,
            self._depth_turn,
            self._depth_shift,
            self.target.focal_length,
            out,
        )
        return colour, out

    def _prepare(self, turn: Float64[np.ndarray, "3 3"]) -> None:
        """Lookups for a rotation; a camera that is fixed to the robot needs them once."""
        wanted = Intrinsics.of(self.target)
        size = self.target.width, self.target.height

        def lookup(source: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
            distortion = np.array(source.distortion or (0.0,) * 5)
            maps = cv2.initUndistortRectifyMap(
                source.matrix, distortion, turn, wanted.matrix, size, cv2.CV_32FC1
            )
            lost = (along <= 0) | (apart >= valid_radius(distortion) * along)
            return np.where(lost, np.float32(-2), maps[0]), np.where(lost, np.float32(-2), maps[1])

        u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        rays = np.stack([(u - wanted.cx) / wanted.fx, (v - wanted.cy) / wanted.fy, np.ones_like(u)])
        x, y, along = np.tensordot(turn.T, rays, axes=1)  # in the source, of a point at depth 1 here
        apart = np.hypot(x, y)
        self._colour_lookup = lookup(self._colour)
        if not self._beside:
            self._depth_lookup = lookup(self.camera.depth_intrinsics)
            self._depth_scale = np.where(along > 0, 1 / np.maximum(along, 1e-6), 0).astype(np.float32)
        else:
            moved = turn @ self.camera.depth_to_colour[:3]
            self._depth_turn, self._depth_shift = moved[:, :3].copy(), moved[:, 3].copy()
        self._turn = turn.copy()


def _near(one: Intrinsics, other: Intrinsics) -> bool:
    same_size = (one.width, one.height) == (other.width, other.height)
    return (
        same_size
        and not any(one.distortion)
        and bool(np.allclose(one.matrix, other.matrix, atol=SAME, rtol=SAME))
    )


def valid_radius(distortion: Float64[np.ndarray, " n"]) -> float:
    """How far from the optical axis, at distance 1, a distortion still moves farther rays farther out.

    Beyond, where it was never fitted, the polynomial of OpenCV's model folds rays back into the image.

    Args:
        distortion: k1, k2, p1, p2[, k3[, k4, k5, k6[, …]]].
    """
    k1, k2, _, _, k3, k4, k5, k6 = [*distortion, *[0.0] * 8][:8]
    radius = np.linspace(0, WIDEST, 10_001)
    square = radius**2
    with np.errstate(divide="ignore", invalid="ignore"):
        above = 1 + square * (k1 + square * (k2 + square * k3))
        moved = radius * above / (1 + square * (k4 + square * (k5 + square * k6)))
    folded = np.flatnonzero(~(np.diff(moved) > 0))  # NaN compares false
    return float(radius[folded[0]]) if len(folded) else float("inf")


def _rays(camera: Intrinsics, stride: int) -> Float64[np.ndarray, "h w 2"]:
    """Where each pixel, or one in `stride`, looks, at distance 1 along the optical axis."""
    u, v = np.meshgrid(np.arange(0, camera.width, stride), np.arange(0, camera.height, stride))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    distortion = np.array(camera.distortion or (0.0,) * 5)
    return cv2.undistortPoints(pixels, camera.matrix, distortion).reshape(*u.shape, 2)


@compiled
def _reproject(
    depth: Float32[np.ndarray, "h w"],
    rays: Float64[np.ndarray, "h w 2"],
    turn: Float64[np.ndarray, "3 3"],
    shift: Float64[np.ndarray, "3"],
    focal: float,
    out: Float32[np.ndarray, "p q"],
) -> None:
    """Carry returns into a camera at another place; the nearest one wins a pixel.

    Each covers as many pixels as lie between it and its neighbours in the source, so that surfaces stay closed.
    """
    rows, columns = out.shape
    height, width = depth.shape
    reach_u = 0.5 * focal * abs(rays[height // 2, width // 2, 0] - rays[height // 2, width // 2 - 1, 0])
    reach_v = 0.5 * focal * abs(rays[height // 2, width // 2, 1] - rays[height // 2 - 1, width // 2, 1])
    for j in range(height):
        for i in range(width):
            d = depth[j, i]
            if not d > 0:
                continue
            x, y = rays[j, i, 0] * d, rays[j, i, 1] * d
            z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * d + shift[2]
            if z <= 0:
                continue
            u = focal * (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * d + shift[0]) / z + columns / 2
            v = focal * (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * d + shift[1]) / z + rows / 2
            reach = d / z
            top, bottom = np.floor(v - reach_v * reach + 0.5), np.ceil(v + reach_v * reach - 0.5)
            left, right = np.floor(u - reach_u * reach + 0.5), np.ceil(u + reach_u * reach - 0.5)
            if bottom <= top:
                top, bottom = np.floor(v), np.floor(v) + 1
            if right <= left:
                left, right = np.floor(u), np.floor(u) + 1
            for row in range(max(int(top), 0), min(int(bottom), rows)):
                for column in range(max(int(left), 0), min(int(right), columns)):
                    if out[row, column] == 0 or z < out[row, column]:
                        out[row, column] = z
