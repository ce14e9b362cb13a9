"""One view at paper size takes 10 ms or less on one core, whatever the size of the map."""

import time

import numpy as np
import pytest

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, project_categories, project_depth
from imagination.mapping.mapper import Mapper
from imagination.mapping.update_rules import MovingAverage
from tests.helpers.raycast import Box, cast

ROOM: Box = ((-1.0, -2.6, 0.0), (4.7, 2.1, 2.6))
BOXES: list[Box] = [((2.0, -1.2, 0.0), (2.5, -0.4, 0.6)), ((3.4, 0.6, 0.0), (4.4, 1.6, 0.9))]
CATEGORIES = ["chair", "bed", "table"]


@pytest.mark.slow
def test_one_view_at_paper_size_takes_ten_milliseconds() -> None:
    median = {extent: latency(Grid.centred(extent, 0.02)) for extent in (40.02, 160.02)}
    print({extent: f"{seconds * 1e3:.2f} ms" for extent, seconds in median.items()})
    assert max(median.values()) <= 0.010
    assert median[160.02] < 1.5 * median[40.02]


def latency(grid: Grid, views: int = 60) -> float:
    """Median over views at random headings: occupancy and seen area, three categories, registration of three layers.

    The time is that of this thread on its core, so that a busy machine does not fail the test.
    """
    camera, ego = Camera.from_degrees(256, 256, 90.0, 1.25), EgoGrid(0.02, 261)
    rng = np.random.default_rng(0)
    depth = cast(camera, ROOM, BOXES)
    labels = rng.integers(0, 4, depth.shape).astype(np.uint8)
    predicted = rng.random((3, 261, 261), dtype=np.float32)
    mapper = Mapper(grid, ego, CATEGORIES, MovingAverage(0.9))
    seconds = []
    for _ in range(views):
        pose = Pose(*rng.uniform(-2, 2, 2).tolist(), rng.uniform(-np.pi, np.pi))
        start = time.thread_time()
        view = project_depth(depth, camera, ego, Band(0.2, 1.5))
        seen_categories = project_categories(depth, labels, camera, ego, 3, Band(0.02, 2.5))
        mapper.register(predicted, seen_categories | view.seen, pose)
        seconds.append(time.thread_time() - start)
    return float(np.median(seconds[10:]))
