import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imagination.evaluation.viewpoints import sparse_viewpoints
from imagination.geometry.grid import Grid
from imagination.scenes.scene import FreeSpace
from imagination.utils.errors import UserError
from imagination.views.pose_samplers import sample_poses

GRID = Grid(0.05, 200, 240, (-3.0, 2.0))


def scene() -> FreeSpace:
    """Free space 8 x 6 m with a block of furniture in it."""
    mask = np.zeros(GRID.shape, np.bool_)
    mask[40:160, 30:190] = True
    mask[80:120, 60:110] = False
    return FreeSpace(GRID, mask)


def mesh_points(free: FreeSpace, width: float) -> np.ndarray:
    """Points of the mesh grid on free space, by loops."""
    centres = [(float(x), float(y)) for x, y in GRID.to_points(np.argwhere(free.mask))]
    x_low, x_high = min(c[0] for c in centres), max(c[0] for c in centres)
    y_low, y_high = min(c[1] for c in centres), max(c[1] for c in centres)
    points = []
    for j in range(int((y_high - y_low) / width + 1e-6) + 1):
        for i in range(int((x_high - x_low) / width + 1e-6) + 1):
            x, y = x_low + i * width, y_low + j * width
            row = GRID.rows - 1 - int(np.floor((y - GRID.origin[1]) / GRID.resolution))
            if free.mask[row, int(np.floor((x - GRID.origin[0]) / GRID.resolution))]:
                points.append((x, y))
    return np.array(points)


@pytest.mark.parametrize("width", [3.0, 2.5, 2.0])
def test_points_are_the_mesh_grid_with_offsets(width: float) -> None:
    free = scene()
    mesh = mesh_points(free, width)
    shared, own = [], []
    for seed in range(200):
        viewpoints = sparse_viewpoints(free, width, np.random.default_rng(seed))
        assert viewpoints.points.shape == mesh.shape
        offsets = viewpoints.points - mesh
        assert (np.ptp(offsets, axis=0) <= width / 3).all()  # what is not shared is at most ± width / 6
        shared.append(offsets.mean(axis=0))
        own.append(offsets - offsets.mean(axis=0))
    assert np.abs(np.array(shared)).max() <= width * (1 / 2 + 1 / 6)
    assert np.abs(np.array(shared)).max() > width * 0.42  # the whole of ± width / 2 is used, in x and in y
    assert np.std(shared, axis=0) == pytest.approx(width / np.sqrt(12), rel=0.15)
    expected = width / 3 / np.sqrt(12) * np.sqrt(1 - 1 / len(mesh))
    assert np.std(own, axis=(0, 1)) == pytest.approx(expected, rel=0.1)


def test_offsets_are_drawn_as_algorithm_1_draws_them() -> None:
    free, width = scene(), 2.0
    rng = np.random.default_rng(7)
    shared = rng.uniform(-1.0, 1.0, 2)
    expected = np.array(
        [point + shared + rng.uniform(-1 / 3, 1 / 3, 2) for point in mesh_points(free, width)]
    )
    assert sparse_viewpoints(free, width, np.random.default_rng(7)).points == pytest.approx(expected)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1.5, 2.0, 2.5, 3.0]))
def test_snapped_points_are_the_nearest_free_cells(seed: int, width: float) -> None:
    free = scene()
    viewpoints = sparse_viewpoints(free, width, np.random.default_rng(seed))
    cells = GRID.to_cells(viewpoints.snapped)
    assert free.mask[cells[:, 0], cells[:, 1]].all()
    assert np.allclose(GRID.to_points(cells), viewpoints.snapped)
    centres = GRID.to_points(np.argwhere(free.mask))
    nearest = np.linalg.norm(viewpoints.points[:, None] - centres[None], axis=2).min(axis=1)
    assert np.allclose(viewpoints.distance, nearest)
    assert np.allclose(np.linalg.norm(viewpoints.points - viewpoints.snapped, axis=1), nearest)


def test_points_are_tested_before_offsets_are_added() -> None:
    """The number of viewpoints is the same in every set, and some of them lie in furniture."""
    free = scene()
    sets = [sparse_viewpoints(free, 2.0, np.random.default_rng(seed)) for seed in range(20)]
    assert len({len(viewpoints.points) for viewpoints in sets}) == 1
    assert max(viewpoints.distance.max() for viewpoints in sets) > 0.3


def test_duplicates_stay() -> None:
    mask = np.zeros(GRID.shape, np.bool_)
    mask[100, 20] = mask[100, 60] = True  # two free cells 2 m apart: with 2 m width both carry a point
    viewpoints = [
        sparse_viewpoints(FreeSpace(GRID, mask), 2.0, np.random.default_rng(seed)) for seed in range(30)
    ]
    assert all(len(one.snapped) == 2 for one in viewpoints)
    assert any((one.snapped[0] == one.snapped[1]).all() for one in viewpoints)


def test_the_same_seed_gives_the_same_viewpoints() -> None:
    first, second, other = (
        sparse_viewpoints(scene(), 2.0, np.random.default_rng(seed)) for seed in (3, 3, 4)
    )
    assert np.array_equal(first.snapped, second.snapped)
    assert not np.array_equal(first.points, other.points)


@pytest.mark.parametrize("width", [0.0, -2.0, np.nan, np.inf])
def test_cell_width_out_of_range_is_refused(width: float) -> None:
    with pytest.raises(UserError, match="cell_width: got .* expected a number in"):
        sparse_viewpoints(scene(), width, np.random.default_rng(0))


def test_a_set_may_be_empty_but_free_space_not() -> None:
    mask = np.zeros(GRID.shape, np.bool_)
    mask[50:100, 99] = mask[50, 50:100] = True  # an L: the lower left corner of its box is not free
    nothing = sparse_viewpoints(FreeSpace(GRID, mask), 9.0, np.random.default_rng(0))
    assert nothing.points.shape == nothing.snapped.shape == (0, 2)
    assert nothing.distance.shape == (0,)
    with pytest.raises(UserError, match="free space: got none"):
        sparse_viewpoints(FreeSpace(GRID, np.zeros(GRID.shape, np.bool_)), 2.0, np.random.default_rng(0))


def test_poses_are_uniform_over_free_space_and_heading() -> None:
    free = scene()
    poses = sample_poses(free, 20_000, np.random.default_rng(0))
    places = np.array([pose[:2] for pose in poses])
    cells = GRID.to_cells(places)
    assert free.mask[cells[:, 0], cells[:, 1]].all()
    centres = GRID.to_points(np.argwhere(free.mask))
    assert places.mean(axis=0) == pytest.approx(centres.mean(axis=0), abs=0.06)
    assert places.std(axis=0) == pytest.approx(centres.std(axis=0), rel=0.02)
    within = (places - GRID.to_points(cells)) / GRID.resolution  # jittered within the cell
    assert within.std(axis=0) == pytest.approx(1 / np.sqrt(12), rel=0.03)
    headings = np.histogram([pose.theta for pose in poses], bins=8, range=(-np.pi, np.pi))[0]
    assert headings.sum() == 20_000
    assert headings == pytest.approx(2500, rel=0.1)


def test_poses_repeat_with_the_seed_and_need_free_space() -> None:
    free = scene()
    assert sample_poses(free, 5, np.random.default_rng(1)) == sample_poses(free, 5, np.random.default_rng(1))
    assert sample_poses(free, 0, np.random.default_rng(1)) == []
    with pytest.raises(UserError, match=r"poses: got 3 .*0 free cells"):
        sample_poses(FreeSpace(GRID, np.zeros(GRID.shape, np.bool_)), 3, np.random.default_rng(1))
