"""Images of a real camera resampled to the camera that a unit was trained with."""

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from imagination.geometry.camera import Camera
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.utils.errors import UserError
from imagination.utils.jit import compiled

WIDEST = 10.0
"""Of a ray's distance from the optical axis, at distance 1: 84 degrees."""

SAME = 1e-6
"""Cameras whose rays differ by less than this many radians, or pixels of focal length, are one."""


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
