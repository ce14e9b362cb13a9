"""Whole-scene maps of hand-made rooms with known results."""

import dataclasses
import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagination.geometry.camera import Camera
from imagination.geometry.grid import Grid
from imagination.geometry.projection import Band
from imagination.ground_truth.scene_maps import (
    GroundTruth,
    GroundTruthSpec,
    box_cells,
    build,
    panorama_points,
)
from imagination.scenes.categories import Category, CategoryTable
from imagination.scenes.free_space import free_space
from imagination.scenes.renderer import Renderer
from imagination.scenes.scene import FreeSpace, Lighting, OrientedBox, Scene, SceneObject
from imagination.utils.errors import UserError
from tests.helpers.rooms import BED, BUILDING, CHAIR, LAMP, TABLE, MeshBuilder, tiny_room

CAMERA = Camera.from_degrees(96, 96, 90.0, 1.25)
SPEC = GroundTruthSpec(8.0, 0.08, 0.5, 0.6, Band(0.2, 1.5), CAMERA)
TABLE_OF = CategoryTable([Category(name, (255, 0, 0)) for name in ("chair", "bed", "table")])
CHAIRS, BEDS, TABLES = range(3)


def ground_truth_of(scene: Scene, **changes: object) -> GroundTruth:
    spec = dataclasses.replace(SPEC, **changes)  # type: ignore[arg-type]
    return build(scene, Renderer(scene.mesh, scene.lighting), spec, TABLE_OF)


def cells_in(grid: Grid, low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
    """Return the cells whose centre is in a rectangle."""
    centres = grid.to_points(np.stack(np.indices(grid.shape), -1))
    return ((centres > np.array(low) - 1e-6) & (centres < np.array(high) + 1e-6)).all(axis=-1)


def hall(
    *boxes: tuple[tuple[float, float, float], tuple[float, float, float]], label_margin: float = 0.0
) -> Scene:
    """Return a 5 x 4 m floor with chairs 1, 2, … as solid boxes, whose labels are larger by `label_margin`."""
    builder = MeshBuilder()
    builder.quad(np.array([[-2.5, -2, 0], [2.5, -2, 0], [2.5, 2, 0], [-2.5, 2, 0]]), BUILDING)
    objects = []
    for instance, (low, high) in enumerate(boxes, start=1):
        builder.box(low, high, instance)
        centre, size = (np.array(low) + high) / 2, np.subtract(high, low) + label_margin
        box = OrientedBox(tuple(centre.tolist()), tuple(size.tolist()), 0.0)
        objects.append(SceneObject(instance, "chair", "chair", box))
    mesh = builder.build()
    return Scene("hall", mesh, Lighting(), tuple(objects), free_space(mesh, 0.0, 0.18))


def test_room_as_expected() -> None:
    """Solid furniture fills its box; the lamp has no category; walls are occupied only."""
    ground_truth = ground_truth_of(tiny_room())
    grid = ground_truth.grid
    boxes = [
        cells_in(grid, (-1.4, 0.2), (-0.95, 0.65)),
        cells_in(grid, (1.0, -1.6), (2.5, 0.4)),
        cells_in(grid, (-1.9, 0.6), (-0.5, 1.4)),
    ]
    np.testing.assert_array_equal(ground_truth.label, boxes)
    np.testing.assert_array_equal(ground_truth.truth[BEDS], boxes[BEDS])
    np.testing.assert_array_equal(ground_truth.truth[TABLES], boxes[TABLES])
    np.testing.assert_array_equal(ground_truth.truth[CHAIRS], boxes[CHAIRS])
    # the chair is pushed under the table: the cells of both boxes belong to both categories
    assert (ground_truth.truth[CHAIRS] & ground_truth.truth[TABLES]).any()
    middle = cells_in(grid, (-0.4, -1.9), (0.9, 1.9))
    assert not ground_truth.occupied[middle].any()
    lamp, wall = cells_in(grid, (-2.1, -1.6), (-2.0, -1.5)), cells_in(grid, (-2.55, -1), (-2.5, 1))
    assert ground_truth.occupied[lamp].any() and ground_truth.occupied[wall].all()
    assert not ground_truth.segmented[:, lamp].any()


def test_boxes_larger_than_their_object_gain_only_occupied_cells_near_its_returns() -> None:
    """A label 2.4 m too wide covers the second object, 0.8 m away; M_seg, dilated by 0.3 m a side, does not."""
    scene = hall(((0.0, 0.0, 0.0), (0.4, 0.4, 0.8)), ((1.2, 0.0, 0.0), (1.6, 0.4, 0.8)), label_margin=2.4)
    scene = dataclasses.replace(
        scene, objects=(scene.objects[0], dataclasses.replace(scene.objects[1], category=None))
    )
    ground_truth = ground_truth_of(scene)
    np.testing.assert_array_equal(
        ground_truth.truth[CHAIRS],
        ground_truth.occupied & cells_in(ground_truth.grid, (-0.1, -0.1), (0.5, 0.5)),
    )
    np.testing.assert_array_equal(
        ground_truth.truth, ground_truth.occupied & ground_truth.label & ground_truth.segmented
    )
    assert (
        ground_truth.occupied & ground_truth.label[CHAIRS] & cells_in(ground_truth.grid, (1.2, 0), (1.6, 0.4))
    ).any()
    assert (ground_truth.label & ground_truth.segmented).sum() > ground_truth.truth.sum() + 10


@pytest.mark.parametrize("size", [0.6, 0.56])
def test_dilation_is_in_metres_and_anchored_as_settled(size: float) -> None:
    """A thin pole has returns in a few cells; M_seg is the square around them."""
    scene = hall(((0.01, 0.01, 0.0), (0.03, 0.03, 1.4)))
    ground_truth = ground_truth_of(scene, dilation=size)
    rows, columns = np.nonzero(ground_truth_of(scene, dilation=0.0).segmented[CHAIRS])
    kernel = round(size / 0.08)  # 8 (up and left 3, down and right 4) and 7
    expected = np.zeros(ground_truth.grid.shape, bool)
    expected[rows.min() - (kernel - 1) // 2 : rows.max() + kernel // 2 + 1,
             columns.min() - (kernel - 1) // 2 : columns.max() + kernel // 2 + 1] = True  # fmt: skip
    assert len(rows) <= 4
    np.testing.assert_array_equal(ground_truth.segmented[CHAIRS], expected)


def test_only_heights_of_obstacles_are_occupied() -> None:
    low, high, floating = (0.0, 0.0, 0.0), (0.5, 0.5, 0.15), ((1.2, 0.0, 1.6), (1.6, 0.4, 2.0))
    ground_truth = ground_truth_of(hall((low, high), floating))
    assert not ground_truth.occupied.any() and not ground_truth.truth.any()
    assert ground_truth.segmented[CHAIRS][
        cells_in(ground_truth.grid, low[:2], high[:2])
    ].all()  # M_seg takes every height
    assert ground_truth.segmented[CHAIRS][cells_in(ground_truth.grid, (1.2, 0.0), (1.6, 0.4))].any()


def test_warns_of_objects_without_ground_truth(caplog: pytest.LogCaptureFixture) -> None:
    scene = hall(((0.0, 0.0, 0.0), (0.5, 0.5, 0.15)), ((1.2, 0.0, 0.0), (1.6, 0.4, 0.8)))
    with caplog.at_level(logging.WARNING):
        ground_truth_of(scene)
    assert "1 of 2 objects of category chair have no cell in the ground truth (instances 1)" in caplog.text
    caplog.clear()
    ground_truth_of(tiny_room())
    assert not caplog.text


@pytest.mark.parametrize(("field_of_view", "height"), [(90.0, 0.0), (75.0, 0.0), (90.0, -3.1)])
def test_sees_all_around_from_one_point(field_of_view: float, height: float) -> None:
    """Eight posts around the only free cell, at any floor height and field of view."""
    directions = np.arange(8) * np.pi / 4 + 0.3
    posts = [(1.5 * np.cos(angle), 1.5 * np.sin(angle)) for angle in directions]
    scene = hall(*[((x - 0.1, y - 0.1, 0.0), (x + 0.1, y + 0.1, 0.8)) for x, y in posts])
    mesh = dataclasses.replace(scene.mesh, vertices=scene.mesh.vertices + np.float32([0, 0, height]))
    grid = Grid(0.05, 1, 1, (-0.025, -0.025))
    free = FreeSpace(grid, np.ones((1, 1), bool))
    scene = dataclasses.replace(
        scene, mesh=mesh, free_space=free, floor_height=height, ceiling_height=height + 2.6
    )
    ground_truth = ground_truth_of(scene, camera=Camera.from_degrees(96, 96, field_of_view, 1.25))
    np.testing.assert_array_equal(ground_truth.points, [[0.0, 0.0]])
    for x, y in posts:
        assert ground_truth.truth[CHAIRS][
            cells_in(ground_truth.grid, (x - 0.1, y - 0.1), (x + 0.1, y + 0.1))
        ].any()


def test_shift_changes_nothing_and_a_quarter_turn_turns() -> None:
    straight, odd = tiny_room(), {"dilation": 0.56}
    original = ground_truth_of(straight, **odd)
    shifted = ground_truth_of(tiny_room(shift=(3.2, -1.6)), **odd)
    turned = ground_truth_of(tiny_room(turn=np.pi / 2), **odd)
    np.testing.assert_allclose(np.subtract(shifted.grid.origin, original.grid.origin), (3.2, -1.6), atol=1e-5)
    np.testing.assert_array_equal(shifted.truth, original.truth)
    np.testing.assert_array_equal(turned.truth, np.rot90(original.truth, axes=(1, 2)))
    assert original.truth.any(axis=(1, 2)).all()


@pytest.mark.parametrize("turn", [0.5, 1.1])
def test_any_turn_keeps_the_area(turn: float) -> None:
    gt = ground_truth_of(tiny_room(turn=turn)).truth
    area = gt.sum(axis=(1, 2)) * SPEC.resolution**2
    np.testing.assert_allclose(area[[BEDS, TABLES]], [1.5 * 2.0, 1.4 * 0.8], rtol=0.04)


def test_image_resolution_hardly_matters() -> None:
    fine = ground_truth_of(tiny_room(turn=0.3), camera=Camera.from_degrees(192, 192, 90.0, 1.25)).truth
    coarse = ground_truth_of(tiny_room(turn=0.3), camera=Camera.from_degrees(64, 64, 90.0, 1.25)).truth
    assert (fine & coarse).sum() / (fine | coarse).sum() > 0.98


def test_scene_larger_than_the_map() -> None:
    with pytest.raises(
        UserError,
        match="scene tiny .*ground_truth.extent 4.0 m, expected at least 5",
    ):
        ground_truth_of(tiny_room(), extent=4.0)


def test_instances_of_the_mesh_must_be_listed() -> None:
    scene = tiny_room()
    with pytest.raises(UserError, match=rf"scene tiny: got .*instances \[{LAMP}\]"):
        ground_truth_of(dataclasses.replace(scene, objects=scene.objects[:-1]))
    assert [obj.instance for obj in scene.objects] == [TABLE, CHAIR, BED, LAMP]


@pytest.mark.parametrize("changes", [{"spacing": 0.0}, {"spacing": float("nan")}, {"dilation": -0.1}])
def test_refuses_bad_settings(changes: dict[str, float]) -> None:
    with pytest.raises(UserError, match=f"ground_truth.{next(iter(changes))}: got"):
        dataclasses.replace(SPEC, **changes)


def test_arrays_and_back() -> None:
    ground_truth = ground_truth_of(tiny_room(shift=(1.0, 2.0)))
    again = GroundTruth.from_arrays(ground_truth.to_arrays())
    assert again.grid == ground_truth.grid
    for name in GroundTruth._fields[1:]:
        np.testing.assert_array_equal(getattr(again, name), getattr(ground_truth, name))


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.05, 3), st.floats(0.05, 3), st.floats(-7, 7))
def test_box_cells_are_those_with_their_centre_between_the_edges(
    x: float, y: float, a: float, b: float, yaw: float
) -> None:
    box = OrientedBox((x, y, 0.5), (a, b, 1.0), yaw)
    grid = Grid.centred(6.0, 0.25)
    centres = grid.to_points(np.stack(np.indices(grid.shape), -1))
    corners = box.footprint()
    edges = np.roll(corners, -1, axis=0) - corners
    away = centres[..., None, :] - corners
    side = (edges[:, 0] * away[..., 1] - edges[:, 1] * away[..., 0]) / np.hypot(*edges.T)
    drawn = np.zeros(grid.shape, bool)
    window, inside = box_cells(box, grid)
    drawn[window] |= inside
    sure = np.abs(side.min(axis=-1)) > 1e-5
    np.testing.assert_array_equal(drawn[sure], (side.min(axis=-1) > 0)[sure])


def test_box_cells_by_hand() -> None:
    """A box 1 m long, turned 30 degrees to the left of +y: its far end is up and left in the map."""
    grid = Grid(0.1, 40, 40, (-2.0, -2.0))
    window, inside = box_cells(OrientedBox((0.0, 0.0, 0.0), (1.0, 0.1, 1.0), np.deg2rad(120)), grid)
    drawn = np.zeros(grid.shape, bool)
    drawn[window] = inside
    # y = 0.35 in row 16: the box spans x from -0.26 to -0.14 there, the centres of columns 17 and 18
    cells = [
        (16, 17),
        (16, 18),
        (17, 18),
        (18, 19),
        (19, 19),
        (20, 20),
        (21, 20),
        (22, 21),
        (23, 21),
        (23, 22),
    ]
    assert list(zip(*np.nonzero(drawn), strict=True)) == cells


@given(st.integers(0, 2**31), st.sampled_from([0.3, 0.5, 1.0]))
def test_points_cover_all_free_space(seed: int, spacing: float) -> None:
    mask = np.random.default_rng(seed).random((31, 47)) < 0.4
    mask[3, 5] = True
    free = FreeSpace(Grid(0.05, 31, 47, (-1.0, 2.0)), mask)
    points = panorama_points(free, spacing)
    assert mask[tuple(free.grid.to_cells(points).T)].all()
    positions = free.grid.to_points(np.argwhere(mask))
    distance = np.abs(positions[:, None] - points).max(axis=-1).min(axis=1)
    assert distance.max() < spacing  # each cell is in the same square as its point
    squares = np.floor((points - positions.min(axis=0)) / spacing + 1e-6)
    assert len(np.unique(squares, axis=0)) == len(points)


def test_points_of_open_floor_stand_spacing_apart() -> None:
    free = FreeSpace(Grid(0.05, 40, 60, (0.0, 0.0)), np.ones((40, 60), bool))
    points = panorama_points(free, 0.5)
    assert len(points) == 4 * 6
    np.testing.assert_allclose(np.unique(points[:, 0].round(3)), 0.275 + 0.5 * np.arange(6), atol=0.026)
