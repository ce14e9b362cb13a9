"""Alignment of RGB-D images: resampling from a real camera to the camera that a unit was trained with."""

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from imagination.geometry.camera import Camera
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.utils.errors import UserError
from imagination.utils.jit import compiled

MAX_RADIUS = 10.0
"""Largest radius that `valid_radius` examines, at depth 1 (84 degrees from the optical axis)."""

TOLERANCE = 1e-6
"""Tolerance for equal cameras: elements of rotation matrices (radians) and intrinsics (pixels)."""


class Alignment:
    """Resampler of images from a robot's camera to an ideal camera at the same position.

    Args:
        camera: camera of the robot.
        target: ideal camera; its mount height is not used.
    """

    def __init__(self, camera: RgbdCamera, target: Camera) -> None:
        self.camera, self.target = camera, target
        # a colour image of higher resolution is downsampled by area averaging first, against aliasing
        self._colour_scale = min(1.0, target.focal_length / abs(camera.colour.fx))
        colour = camera.colour.scaled(self._colour_scale) if self._colour_scale < 1 else camera.colour
        self._colour = colour
        self._is_identity = camera.depth is None and _is_close(camera.colour, Intrinsics.of(target))
        self._has_offset = not np.allclose(camera.depth_to_colour, np.eye(4), atol=1e-9)
        if self._has_offset:
            # a depth image of more than twice the resolution of the target is subsampled
            self._stride = max(1, int(abs(camera.depth_intrinsics.fx) / (2 * target.focal_length)))
            self._depth_rays = _rays(camera.depth_intrinsics, self._stride)
        self._lookup_turn: Float64[np.ndarray, "3 3"] | None = None  # rotation that the lookup tables are for

    def __call__(
        self,
        rgb: UInt8[np.ndarray, "h w 3"],
        depth: Float32[np.ndarray, "k l"],
        turn: Float64[np.ndarray, "3 3"],
    ) -> tuple[UInt8[np.ndarray, "p q 3"], Float32[np.ndarray, "p q"]]:
        """Resample colour and depth to the ideal camera; pixels outside the field of view of the robot's camera are 0.

        Args:
            rgb: colour image.
            depth: depth along the optical axis of the depth camera, metres; 0 where there is no return.
            turn: rotation from the optical frame of the colour camera to that of the ideal camera.

        Raises:
            UserError: if an image does not have the size of the camera's intrinsics.
        """
        for name, image, intrinsics in (
            ("rgb", rgb, self.camera.colour),
            ("depth", depth, self.camera.depth_intrinsics),
        ):
            if image.shape[:2] != (intrinsics.height, intrinsics.width):
                raise UserError(
                    f"{name}: got {image.shape[1]} x {image.shape[0]} pixels, expected "
                    f"{intrinsics.width} x {intrinsics.height}; pass the intrinsics of this image size"
                )
        if self._is_identity and np.allclose(turn, np.eye(3), atol=TOLERANCE):
            return rgb, depth
        if self._lookup_turn is None or not np.allclose(turn, self._lookup_turn, rtol=0, atol=TOLERANCE):
            self._prepare(turn)
        if self._colour_scale < 1:
            size = self._colour.width, self._colour.height
            rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        colour = cv2.remap(rgb, *self._colour_lookup, cv2.INTER_LINEAR)
        if not self._has_offset:
            resampled = cv2.remap(depth, *self._depth_lookup, cv2.INTER_NEAREST)
            return colour, resampled * self._depth_scale
        out = np.zeros((self.target.height, self.target.width), np.float32)
        _reproject(
            depth[:: self._stride, :: self._stride],
            self._depth_rays,
            self._depth_rotation,
            self._depth_translation,
            self.target.focal_length,
            out,
        )
        return colour, out

    def _prepare(self, turn: Float64[np.ndarray, "3 3"]) -> None:
        """Compute the lookup tables for a rotation; a camera that is fixed to the robot needs only one computation."""
        intrinsics = Intrinsics.of(self.target)
        size = self.target.width, self.target.height

        def lookup(source: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
            distortion = np.array(source.distortion or (0.0,) * 5)
            maps = cv2.initUndistortRectifyMap(
                source.matrix, distortion, turn, intrinsics.matrix, size, cv2.CV_32FC1
            )
            # invalid rays get coordinates outside the image, where remap returns 0
            invalid = (z <= 0) | (radius >= valid_radius(distortion) * z)
            return np.where(invalid, np.float32(-2), maps[0]), np.where(invalid, np.float32(-2), maps[1])

        u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        rays = np.stack(
            [(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones_like(u)]
        )
        x, y, z = np.tensordot(turn.T, rays, axes=1)  # in the source frame, for depth 1 in the target
        radius = np.hypot(x, y)
        self._colour_lookup = lookup(self._colour)
        if not self._has_offset:
            self._depth_lookup = lookup(self.camera.depth_intrinsics)
            # depth in the target for depth 1 in the source
            self._depth_scale = np.where(z > 0, 1 / np.maximum(z, 1e-6), 0).astype(np.float32)
        else:
            transform = turn @ self.camera.depth_to_colour[:3]
            self._depth_rotation, self._depth_translation = transform[:, :3].copy(), transform[:, 3].copy()
        self._lookup_turn = turn.copy()


def _is_close(camera: Intrinsics, ideal: Intrinsics) -> bool:
    """Return whether a camera has no distortion and the image size and rays of an ideal camera."""
    same_size = (camera.width, camera.height) == (ideal.width, ideal.height)
    return (
        same_size
        and not any(camera.distortion)
        and bool(np.allclose(camera.matrix, ideal.matrix, atol=TOLERANCE, rtol=TOLERANCE))
    )


def valid_radius(distortion: Float64[np.ndarray, " n"]) -> float:
    """Return the largest radius, at depth 1, up to which the radial distortion is monotonic; inf if it always is.

    Larger radii are outside the range that the distortion polynomial was calibrated for; OpenCV would project their
    rays back into the image.

    Args:
        distortion: coefficients k1, k2, p1, p2[, k3[, k4, k5, k6[, …]]].
    """
    k1, k2, _, _, k3, k4, k5, k6 = [*distortion, *[0.0] * 8][:8]
    radius = np.linspace(0, MAX_RADIUS, 10_001)
    r2 = radius**2
    with np.errstate(divide="ignore", invalid="ignore"):
        numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        distorted = radius * numerator / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    folded = np.flatnonzero(~(np.diff(distorted) > 0))  # NaN compares false
    return float(radius[folded[0]]) if len(folded) else float("inf")


def _rays(camera: Intrinsics, stride: int) -> Float64[np.ndarray, "h w 2"]:
    """Return the ray of every `stride`-th pixel as x, y at depth 1."""
    u, v = np.meshgrid(np.arange(0, camera.width, stride), np.arange(0, camera.height, stride))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    distortion = np.array(camera.distortion or (0.0,) * 5)
    return cv2.undistortPoints(pixels, camera.matrix, distortion).reshape(*u.shape, 2)


@compiled
def _reproject(
    depth: Float32[np.ndarray, "h w"],
    rays: Float64[np.ndarray, "h w 2"],
    rotation: Float64[np.ndarray, "3 3"],
    translation: Float64[np.ndarray, "3"],
    focal: float,
    out: Float32[np.ndarray, "p q"],
) -> None:
    """Reproject a depth image into a camera at another position; each pixel of `out` gets the smallest depth.

    A depth pixel is written to all pixels of `out` up to halfway to its neighbours, so that surfaces have no holes.
    """
    rows, columns = out.shape
    height, width = depth.shape
    half_width = 0.5 * focal * abs(rays[height // 2, width // 2, 0] - rays[height // 2, width // 2 - 1, 0])
    half_height = 0.5 * focal * abs(rays[height // 2, width // 2, 1] - rays[height // 2 - 1, width // 2, 1])
    for j in range(height):
        for i in range(width):
            d = depth[j, i]
            if not d > 0:
                continue
            x, y = rays[j, i, 0] * d, rays[j, i, 1] * d
            z = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * d + translation[2]
            if z <= 0:
                continue
            u = (
                focal * (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * d + translation[0]) / z
                + columns / 2
            )
            v = (
                focal * (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * d + translation[1]) / z
                + rows / 2
            )
            scale = d / z
            top, bottom = np.floor(v - half_height * scale + 0.5), np.ceil(v + half_height * scale - 0.5)
            left, right = np.floor(u - half_width * scale + 0.5), np.ceil(u + half_width * scale - 0.5)
            if bottom <= top:
                top, bottom = np.floor(v), np.floor(v) + 1
            if right <= left:
                left, right = np.floor(u), np.floor(u) + 1
            for row in range(max(int(top), 0), min(int(bottom), rows)):
                for column in range(max(int(left), 0), min(int(right), columns)):
                    if out[row, column] == 0 or z < out[row, column]:
                        out[row, column] = z
