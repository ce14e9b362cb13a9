from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, project_categories, project_depth, splat, validate_depth
from imagination.utils.errors import UserError
from tests.helpers.raycast import Box, cast, pixel_rays

OBSTACLES = Band(0.2, 1.5)
EVERYTHING = Band(-1.0, 3.0)
PAPER = EgoGrid(0.02, 261)
SMALL = EgoGrid(0.06, 87)
ROOM: Box = ((-1.0, -2.6, 0.0), (4.7, 2.1, 2.6))
BOXES: list[Box] = [
    ((2.0, -1.2, 0.0), (2.5, -0.4, 0.6)),  # a cupboard
    ((3.4, 0.6, 0.0), (4.4, 1.6, 0.9)),
    ((1.5, 0.7, 0.0), (1.8, 1.1, 2.0)),  # taller than the band
]


def camera(pixels: int = 64, pitch: float = 0.0, field_of_view: float = 90.0, roll: float = 0.0) -> Camera:
    return Camera.from_degrees(pixels, pixels, field_of_view, 1.25, pitch, roll)


class Return(NamedTuple):
    """Cell of the egocentric map and height of the return of one pixel, computed in plain NumPy."""

    row: int
    column: int
    height: float


def returns(depth: np.ndarray, cam: Camera, grid: EgoGrid) -> dict[tuple[int, int], Return]:
    rays = pixel_rays(cam)
    all_returns = {}
    for v, u in np.argwhere(depth > 0):
        forward, left, up = float(depth[v, u]) * rays[v, u] + [0, 0, cam.mount_height]
        row = grid.cells - 1 - int(np.floor(forward / grid.resolution + 0.5))
        column = grid.cells // 2 - int(np.ceil(left / grid.resolution - 0.5))
        all_returns[v, u] = Return(row, column, up)
    return all_returns


def intersection_over_union(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_one_return_by_hand() -> None:
    # 64 pixels at 90 degrees: focal length 32. Pixel (u 40, v 50) at 2 m: forward 2, right 2 * 8.5 / 32 = 0.53,
    # height 1.25 - 2 * 18.5 / 32 = 0.09: floor. In cells of 0.06 m: 33.3 ahead of row 86, 8.85 right of column 43.
    depth = np.zeros((64, 64), np.float32)
    depth[50, 40] = 2.0
    view = project_depth(depth, camera(), SMALL, OBSTACLES)
    assert np.argwhere(view.seen).tolist() == [[53, 52]]
    assert not view.occupied.any()
    # Pixel (u 10, v 40) at 3 m: right 3 * -21.5 / 32 = -2.02, height 1.25 - 3 * 8.5 / 32 = 0.45: an obstacle.
    depth = np.zeros((64, 64), np.float32)
    depth[40, 10] = 3.0
    view = project_depth(depth, camera(), SMALL, OBSTACLES)
    assert np.argwhere(view.seen).tolist() == [[36, 9]]
    assert np.array_equal(view.seen, view.occupied)


@pytest.mark.parametrize("grid", [PAPER, SMALL])
@pytest.mark.parametrize("pitch", [0.0, 15.0, -10.0])
def test_occupied_cells_are_those_of_the_loop(grid: EgoGrid, pitch: float) -> None:
    cam = camera(64, pitch)
    depth = cast(cam, ROOM, BOXES)
    expected = np.zeros((grid.cells, grid.cells), np.bool_)
    for place in returns(depth, cam, grid).values():
        if 0.2 <= place.height <= 1.5 and 0 <= place.row < grid.cells and 0 <= place.column < grid.cells:
            expected[place.row, place.column] = True
    view = project_depth(depth, cam, grid, OBSTACLES)
    assert expected.sum() > 40
    assert np.array_equal(view.occupied, expected)
    assert view.seen[expected].all()


@pytest.mark.parametrize("pitch", [0.0, 15.0])
def test_seen_cells_follow_the_rule(pitch: float) -> None:
    """Cells that must be seen and cells that may be seen: an image column is one pixel wide, within one cell."""
    grid, cam = SMALL, camera(64, pitch)
    depth = cast(cam, ROOM, BOXES)
    rays = pixel_rays(cam)
    all_returns = returns(depth, cam, grid)
    must, may = np.zeros((2, grid.cells + 2, grid.cells + 2), np.bool_)

    def mark(target: np.ndarray, row: float, column: float) -> None:
        r, c = int(np.floor(row + 0.5)), int(np.floor(column + 0.5))
        if -1 <= r <= grid.cells and -1 <= c <= grid.cells:
            target[r + 1, c + 1] = True

    for (v, u), place in all_returns.items():
        if place.height > 1.5:
            continue
        mark(must, place.row, place.column)
        below = all_returns.get((v + 1, u))
        if below is None or not (place.height < 0.2 and below.height < 0.2):
            continue
        ends = np.stack([depth[v + k, u] * rays[v + k, u, :2] for k in (0, 1)]) / grid.resolution
        half = float(depth[v : v + 2, u].max()) / 64 / grid.resolution  # half a pixel's width there, in cells
        for fraction in np.linspace(0, 1, 60):
            forward, left = ends[0] + fraction * (ends[1] - ends[0])
            if abs(forward - round(forward)) < 0.01:  # on the centre line of a row of cells: certainly seen
                mark(must, grid.cells - 1 - round(forward), grid.cells // 2 - left)
            for side in np.linspace(-1, 1, 9):
                mark(may, grid.cells - 1 - forward, grid.cells // 2 - left + side * half)
    must, may = must[1:-1, 1:-1], (must | may)[1:-1, 1:-1]
    seen = project_depth(depth, cam, grid, OBSTACLES).seen
    assert must.sum() > 1000
    assert seen[must].all()
    assert may[seen].mean() > 0.995
    assert seen[may].mean() > 0.97


def floor_pair(pixels: int = 64) -> tuple[Camera, np.ndarray]:
    """Two vertically adjacent floor returns just right of the image's middle, 3.81 and 3.48 m ahead."""
    cam = camera(pixels)
    depth = np.zeros((pixels, pixels), np.float32)
    for v in (42, 43):
        depth[v, 32] = 1.25 * 32 / (v + 0.5 - 32)
    return cam, depth


def test_floor_between_two_floor_returns_is_seen() -> None:
    cam, depth = floor_pair()
    far, near = depth[42, 32], depth[43, 32]
    rows = np.flatnonzero(project_depth(depth, cam, PAPER, OBSTACLES).seen.any(axis=1))
    assert rows.tolist() == list(range(260 - round(far / 0.02), 260 - round(near / 0.02) + 1))
    # the strip is as wide as a pixel there: 3.65 m / 32 = 0.114 m, 5.7 cells
    middle = project_depth(depth, cam, PAPER, OBSTACLES).seen[260 - 182]
    assert 6 <= middle.sum() <= 7
    assert abs(np.flatnonzero(middle).mean() - (130 + 182 * 0.5 / 32)) < 0.6


@pytest.mark.parametrize("change", ["gap", "apart", "not floor", "sideways"])
def test_floor_elsewhere_is_not_filled(change: str) -> None:
    cam, depth = floor_pair()
    far = depth[42, 32]
    if change == "gap":  # two rows apart, no return between
        depth[42, 32], depth[41, 32] = 0, 1.25 * 32 / 9.5
    elif change == "apart":  # in neighbouring columns
        depth[42, 33], depth[42, 32] = far, 0
    elif change == "not floor":  # the upper return is 0.25 m high
        depth[42, 32] = 1.0 * 32 / 10.5
    else:  # side by side
        depth[43, 32], depth[42, 33] = 0, far
    assert project_depth(depth, cam, PAPER, OBSTACLES).seen.sum() == 2


def test_returns_below_the_band_are_floor() -> None:
    cam, depth = floor_pair()
    depth[42, 32] = (
        (1.25 - 0.19) * 32 / 10.5
    )  # a return 0.19 m high is still floor, at 3.23 m, nearer than the other
    assert project_depth(depth, cam, PAPER, OBSTACLES).seen.sum() > 10


def test_returns_above_the_band_do_not_count() -> None:
    cam = camera()
    depth = np.zeros((64, 64), np.float32)
    depth[:20] = 2.0  # at least 1.25 + 2 * 12.5 / 32 = 2.03 m up
    view = project_depth(depth, cam, SMALL, OBSTACLES)
    assert not view.seen.any()
    assert project_depth(depth, cam, SMALL, Band(0.2, 4.0)).occupied.any()


def test_band_is_inclusive_and_floor_lies_below_it() -> None:
    cam = camera()
    depth = np.zeros((64, 64), np.float32)
    depth[31, 32] = 8.0  # 1.25 + 8 * 0.5 / 32 = 1.375 exactly
    wide = EgoGrid(0.06, 301)
    for low, high, occupied, seen in [
        (0.2, 1.375, 1, 1),
        (1.375, 1.5, 1, 1),
        (1.376, 1.5, 0, 1),
        (0.2, 1.374, 0, 0),
    ]:
        view = project_depth(depth, cam, wide, Band(low, high))
        assert (view.occupied.sum(), view.seen.sum()) == (occupied, seen)


def test_a_box_hides_the_floor_behind_it() -> None:
    cam = camera(256)
    box: Box = ((2.0, -0.5, 0.0), (2.4, 0.5, 0.8))
    seen = project_depth(cast(cam, ROOM, [box]), cam, PAPER, OBSTACLES).seen
    empty = project_depth(cast(cam, ROOM, []), cam, PAPER, OBSTACLES).seen
    # the ray over the box's far edge meets the floor at 2.4 * 1.25 / 0.45 = 6.7 m: all behind is hidden up to the wall
    shadow = np.zeros_like(seen)
    shadow[260 - 230 : 260 - 124, 130 - 20 : 130 + 21] = True
    assert empty[shadow].all()
    assert not seen[shadow].any()
    assert seen[260 - 95 : 260 - 70, 130 - 20 : 130 + 21].all()  # in front of it
    assert seen[260 - 200, 130 - 90]  # next to its shadow
    assert seen[260 - 200, 130 + 90]


def test_a_ray_that_passes_above_a_cell_does_not_see_it() -> None:
    cam = camera(256)
    seen = project_depth(cast(cam, ROOM, []), cam, PAPER, OBSTACLES).seen
    nearest = 1.25 * 128 / 127.5  # the lowest ray meets the floor there
    assert not seen[260 - int(nearest / 0.02) + 2 :].any()
    assert seen[260 - int(nearest / 0.02) - 2, 130]
    wall = np.full((256, 256), 3.0, np.float32)
    wall[128:] = 0  # only rays above the horizon return
    assert project_depth(wall, cam, PAPER, OBSTACLES).seen.any(axis=1).nonzero()[0].tolist() == [110]


@pytest.mark.parametrize("boxes", [[], BOXES[1:2], BOXES[2:]])
@pytest.mark.parametrize("grid", [PAPER, SMALL])
@pytest.mark.parametrize("pitch", [0.0, 15.0])
def test_seen_does_not_depend_on_the_images_resolution(boxes: list[Box], grid: EgoGrid, pitch: float) -> None:
    coarse, fine = (
        project_depth(cast(camera(pixels, pitch), ROOM, boxes), camera(pixels, pitch), grid, OBSTACLES).seen
        for pixels in (64, 512)
    )
    assert intersection_over_union(coarse, fine) >= 0.95


def test_seen_floor_is_the_floor_in_view() -> None:
    """In an empty room: cells in the field of view, beyond the lowest ray and before the walls."""
    cam = camera(256)
    seen = project_depth(cast(cam, ROOM, []), cam, PAPER, OBSTACLES).seen
    points = PAPER.to_points(np.argwhere(np.ones((261, 261), np.bool_))).reshape(261, 261, 2)
    forward, left = points[..., 0], points[..., 1]
    inside = (forward > 1.25) & (np.abs(left) < forward) & (forward < 4.7) & (-2.6 < left) & (left < 2.1)
    assert intersection_over_union(seen, inside) > 0.98


@pytest.mark.parametrize("roll", [12.0, -25.0])
def test_a_rolled_camera_sees_the_floor_in_view(roll: float) -> None:
    """Reference: the centre of each cell of an empty floor is projected into the image."""
    cam = camera(256, pitch=20.0, roll=roll)
    points = PAPER.to_points(np.argwhere(np.ones((261, 261), np.bool_)))
    homogeneous = np.column_stack([points, np.zeros(len(points)), np.ones(len(points))])
    x, y, z = (np.linalg.inv(cam.to_robot()) @ homogeneous.T)[:3]
    in_view = ((z > 0.01) & (np.abs(x) < z) & (np.abs(y) < z)).reshape(261, 261)
    v, u = np.mgrid[:256, :256] + 0.5
    down = (
        cam.to_robot()[2, :3] @ np.stack([(u - 128) / 128, (v - 128) / 128, np.ones_like(u)]).reshape(3, -1)
    ).reshape(u.shape)
    depth = np.where(down < -0.02, -1.25 / np.minimum(down, -0.02), 0).astype(np.float32)
    seen = project_depth(depth, cam, PAPER, OBSTACLES).seen
    assert intersection_over_union(seen, in_view) > 0.97


def test_depth_beyond_the_range_does_not_count() -> None:
    cam, depth = floor_pair()
    far, near = depth[42, 32], depth[43, 32]
    assert project_depth(depth, cam, PAPER, OBSTACLES, float(near) + 0.01).seen.sum() == 1
    assert project_depth(depth, cam, PAPER, OBSTACLES, float(near) - 0.01).seen.sum() == 0
    assert project_depth(depth, cam, PAPER, OBSTACLES, float(far)).seen.sum() > 10


def test_enormous_depth_is_clipped_at_the_rim() -> None:
    cam = camera()
    depth = np.full((64, 64), 3e38, np.float32)
    assert not project_depth(depth, cam, PAPER, OBSTACLES).occupied.any()
    cam, depth = floor_pair()
    depth[42, 32] = 1e30
    rows = np.flatnonzero(project_depth(depth, cam, PAPER, OBSTACLES).seen.any(axis=1))
    assert rows.max() == 260 - round(float(depth[43, 32]) / 0.02)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_mirrored_images_give_mirrored_maps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 6, (32, 32)).astype(np.float32) * (rng.random((32, 32)) < 0.7)
    cam = camera(32, pitch=20.0)
    view = project_depth(depth, cam, SMALL, OBSTACLES)
    mirrored = project_depth(depth[:, ::-1].copy(), cam, SMALL, OBSTACLES)
    assert np.array_equal(view.occupied[:, ::-1], mirrored.occupied)
    assert np.array_equal(view.seen[:, ::-1], mirrored.seen)


def test_categories_are_those_of_the_loop() -> None:
    cam = camera(64, pitch=10.0)
    depth = cast(cam, ROOM, BOXES)
    labels = np.random.default_rng(0).integers(0, 4, depth.shape).astype(np.uint8)
    band = Band(0.05, 2.2)
    expected = np.zeros((3, 87, 87), np.bool_)
    for (v, u), place in returns(depth, cam, SMALL).items():
        if labels[v, u] and 0.05 <= place.height <= 2.2 and 0 <= place.row < 87 and 0 <= place.column < 87:
            expected[labels[v, u] - 1, place.row, place.column] = True
    assert np.array_equal(project_categories(depth, labels, cam, SMALL, 3, band), expected)
    assert not project_categories(depth, labels, cam, SMALL, 3, band, 0.1).any()


def world_loop(
    depth: np.ndarray, cam: Camera, pose: Pose, floor: float, band: Band, grid: Grid
) -> np.ndarray:
    rays = pixel_rays(cam)
    out = np.zeros(grid.shape, np.bool_)
    for v, u in np.argwhere(depth > 0):
        forward, left, up = float(depth[v, u]) * rays[v, u]
        x = pose.x + np.cos(pose.theta) * forward - np.sin(pose.theta) * left
        y = pose.y + np.sin(pose.theta) * forward + np.cos(pose.theta) * left
        row = grid.rows - 1 - int(np.floor((y - grid.origin[1]) / grid.resolution))
        column = int(np.floor((x - grid.origin[0]) / grid.resolution))
        if (
            band.low <= up + cam.mount_height <= band.high
            and 0 <= row < grid.rows
            and 0 <= column < grid.columns
        ):
            out[row, column] = True
    return out


@pytest.mark.parametrize("theta", [0.0, 0.7, np.pi / 2, -2.5])
@pytest.mark.parametrize("floor", [0.0, -2.7])
def test_splat_is_that_of_the_loop(theta: float, floor: float) -> None:
    cam, pose, grid = camera(64, 10.0), Pose(1.03, -0.57, theta), Grid(0.05, 130, 110, (-2.21, -3.33))
    depth = cast(cam, ROOM, BOXES)
    out = np.zeros(grid.shape, np.bool_)
    splat(depth, cam, cam.to_world(pose, floor), floor, OBSTACLES, grid, out)
    expected = world_loop(depth, cam, pose, floor, OBSTACLES, grid)
    assert expected.sum() > 40
    assert np.array_equal(out, expected)


def test_splat_keeps_marked_cells_and_adds_selected_pixels() -> None:
    cam, pose, grid = camera(64), Pose(0.0, 0.0, 0.3), Grid.centred(12.0, 0.05)
    depth = cast(cam, ROOM, BOXES)
    select = np.random.default_rng(1).random(depth.shape) < 0.3
    out = np.zeros(grid.shape, np.bool_)
    out[3, 4] = True
    splat(depth, cam, cam.to_world(pose), 0.0, OBSTACLES, grid, out, 4.0, select)
    expected = world_loop(np.where(select & (depth <= 4.0), depth, 0), cam, pose, 0.0, OBSTACLES, grid)
    expected[3, 4] = True
    assert np.array_equal(out, expected)


@settings(max_examples=25, deadline=None)
@given(st.integers(-20, 20), st.integers(-20, 20), st.integers(0, 3))
def test_splat_follows_whole_cell_shifts_and_quarter_turns(dx: int, dy: int, turns: int) -> None:
    cam, grid = camera(32, 10.0), Grid.centred(20.0, 0.0625)  # a resolution that is exact in floating point
    rng = np.random.default_rng(5)
    depth = rng.uniform(1, 4, (32, 32)).astype(np.float32)
    base, moved = np.zeros((2, *grid.shape), np.bool_)
    splat(depth, cam, cam.to_world(Pose(0.01, 0.02, 0.3)), 0.0, EVERYTHING, grid, base)
    x, y = [(0.01, 0.02), (-0.02, 0.01), (-0.01, -0.02), (0.02, -0.01)][turns]
    pose = Pose(x + dx * 0.0625, y + dy * 0.0625, 0.3 + turns * np.pi / 2)
    splat(depth, cam, cam.to_world(pose), 0.0, EVERYTHING, grid, moved)
    assert np.array_equal(np.roll(np.rot90(base, turns), (-dy, dx), (0, 1)), moved)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (np.zeros((64, 32), np.float32), r"depth: got shape \(64, 32\), expected \(64, 64\)"),
        (np.zeros((64, 64)), "depth: got float64, expected float32"),
        (np.full((64, 64), np.nan, np.float32), "depth: got nan in 4096 of 4096 pixels"),
        (np.full((64, 64), np.inf, np.float32), "depth: got inf"),
        (np.where(np.eye(64) > 0, -1, 1).astype(np.float32), "depth: got -1.0 in 64 of"),
    ],
)
def test_bad_depth_is_refused(depth: np.ndarray, message: str) -> None:
    with pytest.raises(UserError, match=message):
        validate_depth(depth, camera())
    if depth.dtype == np.float32:
        with pytest.raises(UserError, match=message):
            project_depth(depth, camera(), SMALL, OBSTACLES)


def test_bad_limits_categories_and_poses_are_refused() -> None:
    depth, labels = np.ones((64, 64), np.float32), np.full((64, 64), 4, np.uint8)
    with pytest.raises(UserError, match="band: got 1.5 to 0.2 m"):
        project_depth(depth, camera(), SMALL, Band(1.5, 0.2))
    with pytest.raises(UserError, match="max_range: got nan"):
        project_depth(depth, camera(), SMALL, OBSTACLES, float("nan"))
    with pytest.raises(UserError, match="categories: got .*indices up to 4, expected .* up to 3"):
        project_categories(depth, labels, camera(), SMALL, 3, OBSTACLES)
    grid = Grid.centred(5.0, 0.05)
    with pytest.raises(UserError, match="camera_to_world: got .*nan"):
        splat(depth, camera(), np.full((4, 4), np.nan), 0.0, OBSTACLES, grid, np.zeros(grid.shape, np.bool_))
    with pytest.raises(UserError, match="out and select: got shapes"):
        splat(depth, camera(), np.eye(4), 0.0, OBSTACLES, grid, np.zeros((3, 3), np.bool_))
