"""Extension of maps, and cells outside maps of fixed size."""

import numpy as np
import pytest

from imagination.geometry.crop import ego_to_grid
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.mapping.mapper import CHUNK, Mapper
from imagination.mapping.update_rules import MovingAverage
from imagination.utils.errors import UserError

EGO = EgoGrid(0.1, 21)


def poses(count: int) -> list[Pose]:
    rng = np.random.default_rng(1)
    return [Pose(*rng.uniform(-12, 12, 2).tolist(), rng.uniform(-3, 3)) for _ in range(count)]


def test_an_extended_map_equals_a_large_one() -> None:
    rng = np.random.default_rng(0)
    side = CHUNK * 0.1
    small = Mapper(Grid(0.1, CHUNK, CHUNK, (0.0, 0.0)), EGO, ["chair", "bed"], MovingAverage(0.9))
    large = Mapper(
        Grid(0.1, 6 * CHUNK, 6 * CHUNK, (-3 * side, -3 * side)), EGO, ["chair", "bed"], MovingAverage(0.9)
    )
    for pose in poses(30):
        values, mask = rng.random((2, 21, 21), dtype=np.float32), rng.random((2, 21, 21)) < 0.7
        small.cover(pose)
        assert small.outside(mask, pose) == 0
        for mapper in (small, large):
            mapper.register(values, mask, pose)
    grid = small.grid
    assert CHUNK < grid.rows < 6 * CHUNK and grid.rows % CHUNK == grid.columns % CHUNK == 0
    row, column = large.grid.to_cells(np.array(grid.origin) + 0.05).tolist()
    window = np.s_[:, row - grid.rows + 1 : row + 1, column : column + grid.columns]
    np.testing.assert_allclose(small.probabilities, large.probabilities[window], atol=1e-6)
    assert small.written.sum() == large.written.sum() > 0
    assert (small.written == large.written[window]).all()


def test_extension_beyond_memory_is_refused_and_changes_nothing() -> None:
    mapper = Mapper(Grid(0.1, CHUNK, CHUNK, (0.0, 0.0)), EGO, ["chair"], MovingAverage(0.9))
    with pytest.raises(UserError, match="map: got .* cells, expected at most 20001"):  # could not be loaded
        mapper.cover(Pose(2000.0, 0.0, 0.0))
    with pytest.raises(UserError, match="map of 40 x 20001 x 20001 cells: got .* GB"):
        Mapper(Grid(0.1, 20_001, 20_001, (0.0, 0.0)), EGO, [f"c{n}" for n in range(40)], MovingAverage(0.9))
    with pytest.raises(UserError, match="pose: got"):
        mapper.cover(Pose(float("nan"), 0.0, 0.0))
    assert mapper.grid.shape == mapper.probabilities.shape[1:] == (CHUNK, CHUNK)


def test_cells_outside_the_map_are_counted() -> None:
    grid = Grid(0.1, 40, 60, (-3.0, -2.0))
    mapper = Mapper(grid, EGO, ["chair", "bed"], MovingAverage(0.9))
    rng = np.random.default_rng(2)
    for pose in [*poses(20), Pose(0.0, 0.0, 1.0), Pose(2.5, 1.0, 0.3)]:
        mask = rng.random((2, 21, 21)) < 0.3
        to_grid = ego_to_grid(EGO, grid, pose)
        brute = 0
        for r, c in np.argwhere(mask[0] | mask[1]):
            row, column = np.floor(to_grid @ [r, c, 1] + 0.5)
            brute += not (0 <= row < 40 and 0 <= column < 60)
        assert mapper.outside(mask, pose) == brute
