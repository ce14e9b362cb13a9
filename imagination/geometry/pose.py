"""Planar poses (docs/concepts/conventions.md: world x, y horizontal, z up; theta counter-clockwise from +x)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Pose(NamedTuple):
    """Planar pose of the robot in the world: x and y in metres, heading theta in radians."""

    x: float
    y: float
    theta: float

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Return the homogeneous transform of planar points from the robot frame to the world frame."""
        cos, sin = np.cos(self.theta), np.sin(self.theta)
        return np.array([[cos, -sin, self.x], [sin, cos, self.y], [0.0, 0.0, 1.0]])

    def to_world(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Transform points from the robot frame (x forward, y left) to the world frame; metres."""
        matrix = self.matrix()
        transformed: np.ndarray = points @ matrix[:2, :2].T + matrix[:2, 2]
        return transformed

    def to_robot(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Transform points from the world frame to the robot frame (x forward, y left); metres."""
        matrix = self.matrix()
        transformed: np.ndarray = (points - matrix[:2, 2]) @ matrix[:2, :2]
        return transformed
