import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from imagination.geometry.crop import crop, ego_to_grid
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.utils.errors import UserError

RESOLUTION = 0.0625  # exact in floating point, so that shifts by whole cells are too
GRID = Grid(RESOLUTION, 40, 50, (-1.0, 2.0))
EGO = EgoGrid(RESOLUTION, 13)
poses = st.builds(Pose, st.floats(-2, 4), st.floats(1, 6), st.floats(-7, 7))


@pytest.fixture(scope="module", autouse=True)
def compiled_crop() -> None:
    """Compile before the tests, so that hypothesis' deadline does not count it."""
    crop(np.zeros(GRID.shape, np.bool_), GRID, Pose(0.0, 0.0, 0.0), EGO)


def on_cell(row: int, column: int, theta: float) -> Pose:
    x, y = GRID.to_points(np.array([row, column]))
    return Pose(float(x), float(y), theta)


def crop_by_loops(
    layer: np.ndarray, grid: Grid, pose: Pose, ego: EgoGrid, shift: tuple[float, float]
) -> np.ndarray:
    """Crop with every source point shifted by (row, column), in cells of the grid."""
    out = np.zeros((ego.cells, ego.cells), np.bool_)
    for r in range(ego.cells):
        for c in range(ego.cells):
            forward, left = (ego.cells - 1 - r) * ego.resolution, (ego.cells // 2 - c) * ego.resolution
            x = pose.x + forward * np.cos(pose.theta) - left * np.sin(pose.theta)
            y = pose.y + forward * np.sin(pose.theta) + left * np.cos(pose.theta)
            row = grid.rows - 1 - int(np.floor((y - grid.origin[1]) / grid.resolution - shift[0]))
            column = int(np.floor((x - grid.origin[0]) / grid.resolution + shift[1]))
            if 0 <= row < grid.rows and 0 <= column < grid.columns:
                out[r, c] = layer[row, column]
    return out


@given(poses)
def test_ego_cells_agree_with_both_grids(pose: Pose) -> None:
    corners = np.array([[0, 0], [0, 12], [12, 0], [12, 12], [3, 7]])
    world = pose.to_world(EGO.to_points(corners))
    row = GRID.rows - (world[:, 1] - GRID.origin[1]) / RESOLUTION - 0.5
    column = (world[:, 0] - GRID.origin[0]) / RESOLUTION - 0.5
    got = ego_to_grid(EGO, GRID, pose) @ np.column_stack([corners, np.ones(5)]).T
    assert np.allclose(got, [row, column], atol=1e-9)


def test_heading_up_the_map_cuts_the_window_as_it_is() -> None:
    layer = np.random.default_rng(0).random(GRID.shape) < 0.5
    got = crop(layer, GRID, on_cell(25, 20, np.pi / 2), EGO)
    assert np.array_equal(got, layer[13:26, 14:27])


@pytest.mark.parametrize("turns", range(4))
def test_quarter_turns_are_exact(turns: int) -> None:
    layer = np.random.default_rng(1).random(GRID.shape) < 0.5
    pose = on_cell(20, 24, np.pi / 2 + turns * np.pi / 2)
    around = layer[20 - 12 : 20 + 13, 24 - 12 : 24 + 13]  # the robot in the middle
    assert np.array_equal(crop(layer, GRID, pose, EGO), np.rot90(around, -turns)[:13, 6:19])


@settings(max_examples=40)
@given(arrays(np.bool_, GRID.shape), poses)
def test_crop_is_that_of_the_loop(layer: np.ndarray, pose: Pose) -> None:
    """Every cell is exact; only a source point on the border of two cells may take the value of either."""
    either = [
        crop_by_loops(layer, GRID, pose, EGO, (row, column))
        for row in (-1e-9, 1e-9)
        for column in (-1e-9, 1e-9)
    ]
    got = crop(layer, GRID, pose, EGO)
    assert (np.any([got == cells for cells in either], axis=0)).all()


@settings(max_examples=40)
@given(st.integers(-8, 8), st.integers(-8, 8), st.floats(-4, 4))
def test_shifting_map_and_robot_by_whole_cells_changes_nothing(dr: int, dc: int, theta: float) -> None:
    wide = np.zeros(GRID.shape, np.bool_)
    wide[12:28, 16:34] = np.random.default_rng(2).random((16, 18)) < 0.5
    here, there = on_cell(20, 25, theta), on_cell(20 + dr, 25 + dc, theta)
    assert np.array_equal(
        crop(wide, GRID, here, EGO), crop(np.roll(wide, (dr, dc), (0, 1)), GRID, there, EGO)
    )


@pytest.mark.parametrize("theta", np.linspace(-3, 3, 13))
def test_solid_shapes_survive_any_turn(theta: float) -> None:
    """A disc and a bar cut at any heading agree with the shapes drawn from their own geometry."""
    grid, ego, pose = Grid.centred(12.0, 0.02), EgoGrid(0.02, 261), Pose(0.313, -0.127, float(theta))

    def shapes(points: np.ndarray) -> np.ndarray:
        x, y = points[..., 0], points[..., 1]
        return (np.hypot(x - 0.8, y - 0.4) < 1.0) | ((np.abs(x) < 3) & (np.abs(y + 1.5) < 0.5))

    drawn = shapes(grid.to_points(np.moveaxis(np.indices(grid.shape), 0, -1)))
    expected = shapes(ego.centres(pose))
    got = crop(drawn, grid, pose, ego)
    assert expected.sum() > 1000
    assert (got & expected).sum() / (got | expected).sum() > 0.97


def test_layers_stay_apart_and_outside_is_false() -> None:
    layers = np.random.default_rng(3).random((2, 3, *GRID.shape)) < 0.5
    pose = Pose(-1.0, 2.0, 0.3)  # on the map's lower left corner
    got = crop(layers, GRID, pose, EGO)
    for index in np.ndindex(2, 3):
        assert np.array_equal(got[index], crop(layers[index], GRID, pose, EGO))
    assert not crop(np.ones(GRID.shape, np.bool_), GRID, Pose(1e300, 0.0, 1.0), EGO).any()
    assert 0 < crop(np.ones(GRID.shape, np.bool_), GRID, pose, EGO).sum() < 169


@pytest.mark.parametrize("pose", [Pose(np.nan, 0.0, 0.0), Pose(0.0, np.inf, 0.0), Pose(0.0, 0.0, -np.inf)])
def test_a_pose_that_is_not_finite_is_refused(pose: Pose) -> None:
    with pytest.raises(UserError, match="pose: got .* expected finite"):
        crop(np.zeros(GRID.shape, np.bool_), GRID, pose, EGO)


def test_a_map_of_another_shape_is_refused() -> None:
    with pytest.raises(UserError, match=r"got shape \(50, 40\), expected \(40, 50\)"):
        crop(np.zeros((50, 40), np.bool_), GRID, Pose(0.0, 0.0, 0.0), EGO)
