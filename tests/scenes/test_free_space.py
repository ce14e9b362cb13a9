"""Free space against distances to every part of the mesh."""

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.spatial import cKDTree

from imagination.scenes.free_space import free_space
from imagination.scenes.scene import FreeSpace, Mesh
from imagination.utils.errors import UserError
from tests.helpers.rooms import ROBOT_RADIUS, MeshBuilder, tiny_room

RESOLUTION = 0.05


def floor(*pieces: tuple[float, float, float, float], height: float = 0.0) -> MeshBuilder:
    """Return a builder with rectangles of floor, each x0, y0, x1, y1."""
    builder = MeshBuilder()
    for x0, y0, x1, y1 in pieces:
        builder.quad([[x0, y0, height], [x1, y0, height], [x1, y1, height], [x0, y1, height]], 0)  # type: ignore[arg-type]
    return builder


def places(free: FreeSpace) -> np.ndarray:
    return free.grid.to_points(np.argwhere(free.mask))


def distance_to(mesh: Mesh, points: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the horizontal distance to the mesh between two heights, by dense sampling of its surface."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)[:, :, None]
    s, r = (grid.ravel()[:, None] for grid in np.meshgrid(np.linspace(0, 1, 100), np.linspace(0, 1, 100)))
    inside = (s + r <= 1).ravel()
    surface = (a + s[inside] * (b - a) + r[inside] * (c - a)).reshape(-1, 3)
    return cKDTree(surface[(surface[:, 2] >= low) & (surface[:, 2] <= high), :2]).query(points)[0]


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_robot_touches_nothing_and_free_space_is_complete(turn: float) -> None:
    scene = tiny_room(turn=turn)
    free = scene.free_space
    centres = free.grid.to_points(np.stack(np.indices(free.mask.shape), -1).reshape(-1, 2))
    distance = distance_to(scene.mesh, centres, 0.05, 1.5).reshape(free.mask.shape)
    assert distance[free.mask].min() >= ROBOT_RADIUS
    local = (centres @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])).reshape(
        *free.mask.shape, 2
    )
    in_room = (np.abs(local) < [2.5, 2.0]).all(axis=-1)
    # an obstacle blocks its whole cell: at most one diagonal is lost
    roomy = in_room & (distance > ROBOT_RADIUS + 1.42 * RESOLUTION)
    parts, _ = label(roomy)
    largest = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
    assert free.mask[largest].all()
    assert free.mask.sum() * RESOLUTION**2 > 9


def test_cells_that_meet_at_a_corner_are_not_joined() -> None:
    free = free_space(floor((0, 0, 1, 1), (1, 1, 2.5, 2.5)).build(), 0.0, 0.1)
    assert free.mask.sum() == 30 * 30 and places(free).min() > 1


def test_bare_floor_is_free_up_to_its_edge() -> None:
    free = free_space(floor((1.0, 2.0, 2.0, 2.5)).build(), 0.0, 0.2)
    assert free.mask.shape == (10, 20) and free.mask.all()
    assert free.grid.origin == pytest.approx((1.0, 2.0)) and free.grid.resolution == RESOLUTION


def test_only_the_larger_room_without_an_open_door() -> None:
    builder = floor((0, 0, 5, 2))
    builder.box((1.95, 0, 0), (2.05, 2, 2.5), 0)
    free = free_space(builder.build(), 0.0, 0.2)
    assert places(free)[:, 0].min() > 2.25 and places(free)[:, 0].max() > 4.9


@pytest.mark.parametrize(("gap", "passes"), [(0.7, True), (0.35, False)])
def test_door_as_wide_as_the_robot(gap: float, passes: bool) -> None:
    builder = floor((0, 0, 5, 2))
    builder.box((1.95, 0, 0), (2.05, 1 - gap / 2, 2.5), 0)
    builder.box((1.95, 1 + gap / 2, 0), (2.05, 2, 2.5), 0)
    assert (places(free_space(builder.build(), 0.0, 0.2))[:, 0].min() < 1) == passes


@pytest.mark.parametrize(
    ("low", "high", "blocks"),
    [(0.0, 0.04, False), (0.0, 0.06, True), (1.45, 1.6, True), (1.55, 2.0, False), (0.0, 2.0, True)],
)
@pytest.mark.parametrize("floor_height", [0.0, -3.2])
def test_only_obstacles_within_the_clearance_block(
    low: float, high: float, blocks: bool, floor_height: float
) -> None:
    builder = floor((0, 0, 2, 2))
    builder.box((0.9, 0.9, low), (1.1, 1.1, high), 1)
    free = free_space(builder.build(shift=(0, 0, floor_height)), floor_height, 0.2)
    row, column = free.grid.to_cells(np.array([1.01, 1.01]))
    assert free.mask[row, column] != blocks


def test_inside_of_furniture_is_not_free() -> None:
    builder = floor((0, 0, 6, 2))
    builder.box(
        (0.5, 0.2, 0.0), (3.5, 1.9, 2.1), 1
    )  # its top is above the clearance: hollow as seen from above
    free = places(free_space(builder.build(), 0.0, 0.2))
    assert not ((free > [0.5, 0.2]) & (free < [3.5, 1.9])).all(axis=1).any()


def test_floor_at_another_height_is_not_free() -> None:
    builder = floor((0, 0, 1, 1))
    builder.quad(np.array([[3, 0, 0.3], [9, 0, 0.3], [9, 9, 0.3], [3, 9, 0.3]]), 0)
    assert places(free_space(builder.build(), 0.0, 0.2)).max() < 1


def test_quarter_turn_turns_the_mask() -> None:
    straight, turned = tiny_room().free_space, tiny_room(turn=np.pi / 2).free_space
    np.testing.assert_array_equal(turned.mask, np.rot90(straight.mask))


@pytest.mark.parametrize(
    ("radius", "floor_height", "message"),
    [
        (0.2, 1.0, "free space: got no horizontal triangle within 0.05 m of the floor at 1.0 m"),
        (3.0, 0.0, r"free space: .*radius 3\.0 m on 21"),
        (np.nan, 0.0, "robot_radius: got nan"),
        (-0.1, 0.0, "robot_radius: got -0.1"),
    ],
)
def test_refuses(radius: float, floor_height: float, message: str) -> None:
    with pytest.raises(UserError, match=message):
        free_space(tiny_room().mesh, floor_height, radius)


def test_refuses_a_scene_in_millimetres() -> None:
    with pytest.raises(UserError, match=r"free space: got a floor from .*5000"):
        free_space(floor((0, 0, 5000, 2000)).build(), 0.0, 0.2)
