"""Samplers of robot poses in a scene."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imagination.geometry.pose import Pose
from imagination.scenes.scene import FreeSpace, Scene
from imagination.utils.errors import UserError, check_range


def sample_poses(free: FreeSpace, count: int, rng: np.random.Generator) -> list[Pose]:
    """Sample poses uniformly over free space (continuous within its cells) and heading.

    Args:
        free: free space of the robot.
        count: number of poses.
        rng: random generator of positions and headings.

    Raises:
        UserError: if the count is negative or there is no free cell.
    """
    cells = np.argwhere(free.mask)
    if count < 0 or len(cells) == 0:
        raise UserError(
            f"poses: got {count} poses on {len(cells)} free cells, expected at least 0 poses on at least 1 cell"
        )
    sampled = cells[rng.integers(len(cells), size=count)]
    jitter = rng.uniform(-0.5, 0.5, (count, 2)) * free.grid.resolution
    positions = free.grid.to_points(sampled) + jitter
    headings = rng.uniform(-np.pi, np.pi, count)
    return [Pose(float(x), float(y), float(theta)) for (x, y), theta in zip(positions, headings, strict=True)]


@dataclass(frozen=True)
class UniformPoses:
    """Uniform sampler over free space and heading (settled reading: no pose is rejected, as in the paper)."""

    def __call__(self, scene: Scene, count: int, rng: np.random.Generator) -> list[Pose]:
        return sample_poses(scene.free_space, count, rng)


@dataclass(frozen=True)
class BalancedPoses:
    """Sampler that turns a fraction of uniform poses towards a nearby object.

    Attributes:
        categories: categories of the objects.
        fraction: probability that a pose is turned, 0 to 1.
        distance: maximum distance of the object, metres.
        spread: half-width of the uniform noise of the heading, radians.
    """

    categories: Sequence[str]
    fraction: float = 0.5
    distance: float = 4.0
    spread: float = 0.6

    def __post_init__(self) -> None:
        check_range("sampler.fraction", self.fraction, 0.0, 1.0)
        check_range("sampler.distance", self.distance, 0.0, 100.0, "m", open_low=True)
        check_range("sampler.spread", self.spread, 0.0, np.pi, "rad")

    def __call__(self, scene: Scene, count: int, rng: np.random.Generator) -> list[Pose]:
        objects = [obj for category in self.categories for obj in scene.of_category(category)]
        centres = np.array([obj.box.centre[:2] for obj in objects])
        poses = []
        for pose in sample_poses(scene.free_space, count, rng):
            # drawn for every pose, so that the random stream does not depend on the scene
            turned = rng.random() < self.fraction
            noise, choice = rng.uniform(-self.spread, self.spread), rng.random()
            offsets = centres - np.array(pose[:2]) if len(centres) else np.empty((0, 2))
            near = offsets[np.hypot(*offsets.T) < self.distance]
            if turned and len(near):
                dx, dy = near[int(choice * len(near))]
                pose = Pose(pose.x, pose.y, float(np.arctan2(dy, dx)) + noise)
            poses.append(pose)
        return poses
