"""Planar poses (docs/conventions.md: world x, y horizontal, z up; theta counter-clockwise from +x)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Pose(NamedTuple):
    """The robot's pose in the world: metres and radians."""

    x: float
    y: float
    theta: float

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Homogeneous transform of planar points from the robot's frame to the world's."""
        cos, sin = np.cos(self.theta), np.sin(self.theta)
        return np.array([[cos, -sin, self.x], [sin, cos, self.y], [0.0, 0.0, 1.0]])

    def to_world(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Points given in the robot's frame (x forward, y left), in the world's frame; metres."""
        matrix = self.matrix()
        world: np.ndarray = points @ matrix[:2, :2].T + matrix[:2, 2]
        return world

    def to_robot(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Points given in the world's frame, in the robot's frame (x forward, y left); metres."""
        matrix = self.matrix()
        robot: np.ndarray = (points - matrix[:2, 2]) @ matrix[:2, :2]
        return robot
