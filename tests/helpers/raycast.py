"""Depth images of a room with boxes by analytic ray casting: an independent reference camera."""

import numpy as np

from imagination.geometry.camera import Camera

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def pixel_rays(camera: Camera) -> np.ndarray:
    """Return the ray directions (h, w, 3) in the robot frame of a camera without roll, 1 along the optical axis."""
    focal = camera.width / 2 / np.tan(camera.field_of_view / 2)
    across = (np.arange(camera.width) + 0.5 - camera.width / 2) / focal
    down = (np.arange(camera.height) + 0.5 - camera.height / 2) / focal
    cos, sin = np.cos(camera.pitch), np.sin(camera.pitch)
    axis, image_down, image_right = np.array([cos, 0, -sin]), np.array([-sin, 0, -cos]), np.array([0, -1, 0])
    return axis + across[None, :, None] * image_right + down[:, None, None] * image_down


def cast(camera: Camera, room: Box, boxes: list[Box]) -> np.ndarray:
    """Return the depth of the inside of a room and of boxes, all given in the robot frame."""
    rays = pixel_rays(camera)
    origin = np.array([0.0, 0.0, camera.mount_height])
    depth = _slabs(origin, rays, room)[1]
    for box in boxes:
        enter, leave = _slabs(origin, rays, box)
        hit = (enter < leave) & (enter > 0)
        depth = np.where(hit, np.minimum(depth, enter), depth)
    return depth.astype(np.float32)


def _slabs(origin: np.ndarray, rays: np.ndarray, box: Box) -> tuple[np.ndarray, np.ndarray]:
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.stack([(np.array(corner) - origin) / rays for corner in box])
    return bounds.min(axis=0).max(axis=-1), bounds.max(axis=0).min(axis=-1)
