"""Random poses of the robot in a home."""

import numpy as np

from imagination.errors import UserError
from imagination.geometry.pose import Pose
from imagination.scenes.scene import FreeSpace


def sample_poses(free: FreeSpace, count: int, rng: np.random.Generator) -> list[Pose]:
    """Poses drawn uniformly over free space, anywhere within its cells, and over all headings.

    Args:
        free: where the robot may stand.
        count: poses wanted.
        rng: drives places and headings.

    Raises:
        UserError: if the count is negative or nothing is free.
    """
    cells = np.argwhere(free.mask)
    if count < 0 or len(cells) == 0:
        raise UserError(
            f"poses: got {count} to draw on {len(cells)} free cells, expected at least 0 on at least 1"
        )
    chosen = cells[rng.integers(len(cells), size=count)]
    jitter = rng.uniform(-0.5, 0.5, (count, 2)) * free.grid.resolution
    places = free.grid.to_points(chosen) + jitter
    headings = rng.uniform(-np.pi, np.pi, count)
    return [Pose(float(x), float(y), float(theta)) for (x, y), theta in zip(places, headings, strict=True)]
