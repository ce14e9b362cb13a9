"""Poses, grids and the camera against the conventions, by examples and round trips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid, cells_of
from imagination.geometry.pose import Pose
from imagination.utils.errors import UserError
from tests.helpers.raycast import pixel_rays

coordinates = st.floats(-50, 50)
poses = st.builds(Pose, coordinates, coordinates, st.floats(-7, 7))


def test_heading_turns_counter_clockwise() -> None:
    pose = Pose(3.0, 5.0, np.pi / 2)
    assert pose.to_world(np.array([[2.0, 0.0], [0.0, 1.0]])) == pytest.approx(
        np.array([[3.0, 7.0], [2.0, 5.0]])
    )


@given(poses, coordinates, coordinates)
def test_world_and_robot_are_inverse(pose: Pose, x: float, y: float) -> None:
    point = np.array([x, y])
    assert np.allclose(pose.to_robot(pose.to_world(point)), point, atol=1e-9)
    assert np.linalg.norm(pose.to_robot(point)) == pytest.approx(np.hypot(x - pose.x, y - pose.y), abs=1e-9)


def test_global_rows_go_down_and_columns_right() -> None:
    grid = Grid(0.5, 4, 6, (10.0, 20.0))
    points = np.array([[10.1, 20.1], [10.1, 21.9], [12.9, 20.1], [11.25, 21.25]])
    assert grid.to_cells(points).tolist() == [[3, 0], [0, 0], [3, 5], [1, 2]]
    assert grid.to_points(np.array([[3, 0], [0, 5]])).tolist() == [[10.25, 20.25], [12.75, 21.75]]
    assert grid.inside(np.array([[0, 0], [3, 5], [4, 0], [0, -1]])).tolist() == [True, True, False, False]


def test_centred_grid_has_a_cell_on_its_centre() -> None:
    grid = Grid.centred(40.02, 0.02, (1.0, -2.0))
    assert grid.shape == (2001, 2001)
    assert grid.to_points(np.array([1000, 1000])) == pytest.approx(np.array([1.0, -2.0]))
    assert grid.origin == pytest.approx((1.0 - 20.01, -2.0 - 20.01))


def test_robot_is_in_the_middle_of_the_last_row_facing_up() -> None:
    ego = EgoGrid.of_extent(5.22, 0.02)
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [2.0, -0.5]])  # ahead is up, left is left
    assert ego.cells == 261
    assert ego.to_cells(points).tolist() == [[260, 130], [210, 130], [260, 80], [160, 155]]


@given(st.integers(0, 86), st.integers(0, 86), st.floats(-0.49, 0.49), st.floats(-0.49, 0.49))
def test_cells_hold_the_points_around_their_centre(row: int, column: int, down: float, right: float) -> None:
    ego, grid, cell = EgoGrid(0.06, 87), Grid.centred(5.22, 0.06), np.array([row, column])
    assert ego.to_cells(ego.to_points(cell) - np.array([down, right]) * 0.06).tolist() == [row, column]
    assert grid.to_cells(grid.to_points(cell) + np.array([right, -down]) * 0.06).tolist() == [row, column]


def test_ego_centres_lie_in_the_world() -> None:
    centres = EgoGrid(0.5, 5).centres(Pose(1.0, 2.0, np.pi))
    assert centres[4, 2] == pytest.approx(np.array([1.0, 2.0]))
    assert centres[0, 2] == pytest.approx(np.array([-1.0, 2.0]))
    assert centres[4, 0] == pytest.approx(np.array([1.0, 1.0]))


@pytest.mark.parametrize("pitch", [0.0, 20.0, -35.0])
def test_camera_frame_is_that_of_the_rays(pitch: float) -> None:
    camera = Camera.from_degrees(16, 12, 80.0, 1.25, pitch)
    centre_x, centre_y = camera.principal_point
    u, v = 13, 2
    optical = np.array(
        [(u + 0.5 - centre_x) / camera.focal_length, (v + 0.5 - centre_y) / camera.focal_length, 1.0]
    )
    transform = camera.to_robot()
    assert transform[:3, :3] @ optical == pytest.approx(pixel_rays(camera)[v, u])
    assert transform[:3, 3] == pytest.approx(np.array([0.0, 0.0, 1.25]))


def test_camera_edges_see_half_the_field_of_view() -> None:
    camera = Camera.from_degrees(64, 64, 90.0, 1.0)
    assert camera.focal_length == pytest.approx(32.0)
    edge = np.arctan((camera.width - camera.principal_point[0]) / camera.focal_length)
    assert edge == pytest.approx(np.pi / 4)


def test_roll_turns_clockwise_as_seen_from_behind() -> None:
    camera = Camera.from_degrees(64, 64, 90.0, 1.0, roll=90.0)
    assert camera.to_robot()[:3, :3] @ [1.0, 0.0, 0.0] == pytest.approx(
        np.array([0.0, 0.0, -1.0])
    )  # image right: down


def test_camera_in_the_world() -> None:
    camera = Camera.from_degrees(64, 64, 90.0, 1.25)
    transform = camera.to_world(Pose(2.0, 3.0, np.pi / 2), floor_height=-3.0)
    point = transform @ [
        0.5,
        0.25,
        4.0,
        1.0,
    ]  # 4 m ahead, 0.5 m to the right, 0.25 m down; ahead is +y, right is +x
    assert point == pytest.approx(np.array([2.5, 7.0, -3.0 + 1.25 - 0.25, 1.0]))


@pytest.mark.parametrize(
    ("extent", "resolution"), [(5.0, 0.0), (5.0, np.nan), (np.inf, 0.02), (0.01, 0.02), (5000.0, 0.02)]
)
def test_maps_out_of_range_are_refused(extent: float, resolution: float) -> None:
    with pytest.raises(UserError, match="got .* expected"):
        cells_of(extent, resolution)
