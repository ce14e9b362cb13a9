"""SemanticMapper: maps of rendered frames, and refused input."""

import re
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import jaxtyping
import numpy as np
import pytest

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import project_depth
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.map import map_frames
from imagination.mapping import semantic_mapper
from imagination.mapping.map_io import LoadedLayer
from imagination.mapping.mapper import Mapper
from imagination.mapping.predictor import Observation, UnitEnsemble, UnitSpec, valid_imagination
from imagination.mapping.semantic_mapper import SemanticMapper, near_obstacles
from imagination.mapping.update_rules import MovingAverage
from imagination.recordings.recording import Frames, Images, Shot
from imagination.scenes.renderer import Renderer
from imagination.utils.errors import UserError
from imagination.viewers.viewer import NoViewer
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import CAMERA, EGO, Toy

POSES = [Pose(0.6, -0.9, 2.2), Pose(0.0, -0.5, 0.3), Pose(0.4, 0.6, -1.5)]


def frames(camera: Camera = CAMERA, poses: list[Pose] = POSES) -> list[tuple[np.ndarray, np.ndarray, Pose]]:
    scene = tiny_room()
    renderer = Renderer(scene.mesh, scene.lighting)
    images = [renderer.render(camera, camera.to_world(pose)) for pose in poses]
    return [(image.rgb, image.depth, pose) for image, pose in zip(images, poses, strict=True)]


def test_evidence_is_registered_as_in_the_evaluation() -> None:
    """The same views through the functions that the evaluation uses, one by one."""
    toy, grid = Toy("chair", "bed"), Grid.centred(9.0, 0.12)
    mapper = SemanticMapper(toy, grid=grid)
    plain = Mapper(grid, EGO, ["chair", "bed"], MovingAverage(0.9))
    for rgb, depth, pose in frames():
        update = mapper.update(rgb, depth, pose)
        view = project_depth(depth, CAMERA, EGO, toy.spec.obstacles)
        prediction = toy(Observation(rgb, depth, view.occupied, view.seen, CAMERA.mount_height))
        evidence = valid_imagination(prediction, view.seen[None], 0.5, 0.62, 0.12)
        plain.register(evidence.values, evidence.mask, pose, evidence.imagined)
        np.testing.assert_array_equal(update.probabilities, prediction)
        assert update.outside == 0
    maps = mapper.maps
    np.testing.assert_array_equal(maps.written, plain.written)
    np.testing.assert_allclose(maps.probabilities, plain.probabilities, atol=1e-6)
    assert (maps.probabilities[0] > 0.5).sum() > 20


def test_occupancy_shows_the_rooms_walls() -> None:
    mapper = SemanticMapper(Toy())
    turned = [Pose(0.3, -0.6, angle) for angle in np.linspace(-3, 3, 9)]
    for frame in frames(poses=turned):
        mapper.update(*frame)
    layer, grid = mapper.maps.occupancy_layer(), mapper.maps.grid
    walls = [(x, -1.97) for x in np.arange(-1.5, 0.8, 0.1)]  # the lower wall, to which nothing stands
    near = [
        (layer[r - 1 : r + 2, c - 1 : c + 2] == 100).any()
        for r, c in (grid.to_cells(np.array(point)).tolist() for point in walls)
    ]
    assert np.mean(near) > 0.9
    row, column = grid.to_cells(np.array([-1.9, -0.5])).tolist()
    assert layer[row, column] == 0
    outside = grid.to_cells(np.array([0.0, -3.0])).tolist()
    assert layer[tuple(outside)] == -1


def test_a_pose_in_six_degrees_of_freedom_is_the_same() -> None:
    ours, theirs = SemanticMapper(Toy()), SemanticMapper(Toy())
    for rgb, depth, pose in frames():
        ours.update(rgb, depth, pose)
        theirs.update(rgb, depth, CAMERA.to_world(pose))
    np.testing.assert_allclose(ours.maps.probabilities, theirs.maps.probabilities, atol=1e-6)


def test_another_floor_height_changes_nothing() -> None:
    ours, theirs = SemanticMapper(Toy()), SemanticMapper(Toy(), floor_height=-3.5)
    for rgb, depth, pose in frames():
        ours.update(rgb, depth, pose)
        theirs.update(rgb, depth, CAMERA.to_world(pose, -3.5))
    np.testing.assert_allclose(ours.maps.occupancy, theirs.maps.occupancy, atol=1e-6)


def test_a_tilted_camera_gives_nearly_the_same_map() -> None:
    tilted = Camera.from_degrees(120, 120, 105.0, 1.4, pitch=12.0)
    mapper, plain = SemanticMapper(Toy(), RgbdCamera.of(tilted)), SemanticMapper(Toy())
    with pytest.warns(UserWarning) as caught:
        for frame in frames(tilted):
            mapper.update(*frame)
    texts = " ".join(str(each.message) for each in caught)
    assert re.search(r"mount_height: .*1\.40 m.* 1\.25", texts)
    assert re.search(r"pitch: .*12\.00 degrees.* 0\.00", texts)
    assert len(caught) == 2  # once, not for every frame
    for frame in frames():
        plain.update(*frame)
    one, other = mapper.maps.occupancy_layer() == 0, plain.maps.occupancy_layer() == 0
    assert (one & other).sum() / (one | other).sum() > 0.75


def test_a_map_of_fixed_size_counts_what_it_loses_and_a_growing_one_loses_nothing() -> None:
    fixed, growing = SemanticMapper(Toy(), grid=Grid.centred(2.0, 0.12)), SemanticMapper(Toy())
    lost = 0
    for frame in frames():
        lost += fixed.update(*frame).outside
        assert growing.update(*frame).outside == 0
    assert lost > 100
    assert growing.maps.known.sum() > fixed.maps.known.sum()
    at = growing.maps.grid.to_cells(fixed.maps.grid.to_points(np.argwhere(fixed.maps.known)))
    assert growing.maps.known[tuple(at.T)].mean() > 0.8  # cells lie elsewhere


def test_it_starts_from_another_robots_map() -> None:
    layer = np.zeros((60, 60), np.int8)
    layer[:10], layer[30, 20:40] = -1, 100
    grid = Grid(0.1, 60, 60, (20.0, 20.0))
    mapper = SemanticMapper(Toy(), start=LoadedLayer(grid, layer))
    maps = mapper.maps
    wall = maps.grid.to_cells(grid.to_points(np.argwhere(layer == 100)))
    assert (maps.occupancy_layer()[tuple(wall.T)] == 100).all()
    assert maps.written.sum() == 0
    before = (maps.occupancy_layer() == 0).sum()
    assert before == pytest.approx((layer == 0).sum() * (0.1 / 0.12) ** 2, rel=0.1)
    for frame in frames():
        mapper.update(*frame)
    assert (mapper.maps.occupancy_layer() == 0).sum() > before + 100


def test_known_cells_outside_a_map_of_fixed_size_are_warned_of() -> None:
    layer = np.zeros((60, 60), np.int8)
    layer[:10] = -1
    start = LoadedLayer(Grid(0.12, 60, 60, (0.0, 0.0)), layer)
    with pytest.warns(UserWarning, match="start: 1500 of .*3000"):
        SemanticMapper(Toy(), start=start, grid=Grid(0.12, 60, 30, (0.0, 0.0)))


def test_cameras_that_differ_too_much_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    narrow = RgbdCamera.of(Camera.from_degrees(48, 48, 35.0, 1.25))
    with pytest.raises(UserError, match=r"horizontal field of view: .*35\.0 .*90\.0.*at most 40"):
        SemanticMapper(Toy(), narrow)
    with monkeypatch.context() as patch, pytest.warns(UserWarning, match=r"field of view: .*35\.0 .*90\.0"):
        wider = replace(semantic_mapper.MAX_DIFFERENCE, field_of_view=60.0, vertical_field_of_view=60.0)
        patch.setattr(semantic_mapper, "MAX_DIFFERENCE", wider)
        SemanticMapper(Toy(), narrow)
    with pytest.warns(UserWarning, match=r"resolution: .*0\.21 .*0\.42"):
        SemanticMapper(Toy(), RgbdCamera.of(Camera.from_degrees(24, 24, 90.0, 1.25)))
    rgb, depth, pose = frames()[0]
    mapper = SemanticMapper(Toy())
    for camera, message in (
        (Camera.from_degrees(48, 48, 90.0, 2.5), r"mount_height: .*2\.50 m"),
        (
            Camera.from_degrees(48, 48, 90.0, 1.25, pitch=60.0),
            r"pitch: .*60\.00 degrees",
        ),
        (
            Camera.from_degrees(48, 48, 90.0, 1.25, roll=-90.0),
            r"roll: .*-90\.00 degrees",
        ),
    ):
        with pytest.raises(UserError, match=message):
            mapper.update(rgb, depth, camera.to_world(pose))


def test_bad_frames_leave_the_map_as_it_was() -> None:
    mapper = SemanticMapper(Toy())
    with pytest.raises(UserError, match="map: got no frame"):
        _ = mapper.maps
    rgb, depth, pose = frames()[0]
    mapper.update(rgb, depth, pose)
    before = mapper.maps.probabilities.copy()
    holes = depth.copy()
    holes[3, 4] = np.nan
    for bad, message in (
        ((rgb, holes, pose), "depth: got nan"),
        ((rgb[:40], depth, pose), "rgb: got 48 x 40 pixels"),
        ((rgb, depth, Pose(np.inf, 0.0, 0.0)), "got .*inf"),
        ((rgb, depth, Pose(1e7, 0.0, 0.0)), "map: got .* cells"),
    ):
        with warnings.catch_warnings(), pytest.raises(UserError, match=message):
            warnings.simplefilter("ignore")
            mapper.update(*bad)
        np.testing.assert_array_equal(mapper.maps.probabilities, before)


def test_warnings_come_once_for_each_quantity_when_it_first_differs() -> None:
    mapper = SemanticMapper(Toy())
    rgb, depth = np.zeros((48, 48, 3), np.uint8), np.full((48, 48), 2.0, np.float32)

    def warned(height: float, pitch: float) -> list[str]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            camera = Camera.from_degrees(48, 48, 90.0, height, pitch=pitch)
            mapper.update(rgb, depth, camera.to_world(Pose(0.0, 0.0, 0.0)))
        return [str(each.message).partition(":")[0] for each in caught]

    assert [warned(1.25, 0.0), warned(1.5, 0.0), warned(1.5, 20.0), warned(1.6, 25.0)] == [
        [],
        ["mount_height"],
        ["pitch"],
        [],
    ]


@pytest.mark.parametrize(
    ("colour", "depth", "message"),
    [
        (Intrinsics(48, 36, 24.0, 24.0, 23.5, 17.5), None, "vertical field of view: .*colour camera"),
        (
            Intrinsics.of(CAMERA),
            Intrinsics(48, 48, 40.0, 24.0, 23.5, 23.5),
            "horizontal field of view: .*depth camera",
        ),
        (
            Intrinsics.of(CAMERA),
            Intrinsics(16, 16, 8.0, 8.0, 7.5, 7.5),
            r"resolution: .*depth camera.*0\.14",
        ),
    ],
)
def test_all_intrinsics_of_both_cameras_are_compared(
    colour: Intrinsics, depth: Intrinsics | None, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.warns(UserWarning, match=message):
        SemanticMapper(Toy(), RgbdCamera(colour, depth))
    strict = replace(
        semantic_mapper.MAX_DIFFERENCE, field_of_view=1.0, vertical_field_of_view=1.0, resolution=1.0
    )
    monkeypatch.setattr(semantic_mapper, "MAX_DIFFERENCE", strict)
    with warnings.catch_warnings(), pytest.raises(UserError, match=message):
        warnings.simplefilter("ignore")
        SemanticMapper(Toy(), RgbdCamera(colour, depth))


def test_images_of_another_type_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a user gives them, to whom nothing else checks types."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    k = Intrinsics(96, 72, 48.0, 48.0, 47.5, 35.5)  # is brought into the units' camera
    mapper = SemanticMapper(Toy(), RgbdCamera(k))
    rgb, depth = np.zeros((72, 96, 3), np.uint8), np.full((72, 96), 2.0, np.float32)
    for bad_rgb, bad_depth, message in (
        (rgb, (1000 * depth).astype(np.uint16), "depth: got uint16"),
        (rgb, depth.astype(np.float64), "depth: got float64"),
        (rgb, depth[..., None], r"depth: got float32 of shape \(72, 96, 1\)"),
        (rgb / np.float32(255), depth, "rgb: got float32"),
        (rgb[..., 0], depth, r"rgb: got uint8 of shape \(72, 96\)"),
        (np.zeros((72, 96, 4), np.uint8), depth, r"rgb: got uint8 of shape \(72, 96, 4\)"),
    ):
        with pytest.raises(UserError, match=message):
            mapper.update(bad_rgb, bad_depth, Pose(0.0, 0.0, 0.0))
    assert mapper.frames == 0


def test_ctrl_c_in_the_first_frame_saves_nothing() -> None:
    class Interrupted(Toy):
        def __call__(self, observation: Observation) -> np.ndarray:
            raise KeyboardInterrupt

    class OneFrame:
        camera, skipped, world = RgbdCamera.of(CAMERA), Counter[str](), "map"

        def shots(self) -> Iterator[Shot]:
            images = Images(np.zeros((48, 48, 3), np.uint8), np.full((48, 48), 2.0, np.float32))
            yield Shot(0, CAMERA.to_world(Pose(0.0, 0.0, 0.0)), lambda: images)

    with pytest.raises(SystemExit) as ended:
        map_frames(SemanticMapper(Interrupted()), Frames(OneFrame()), NoViewer())
    assert ended.value.code == 130


def test_gaps_of_a_dashed_wall_are_not_free() -> None:
    occupied = np.zeros((40, 40), np.bool_)
    occupied[10, 5:30:4] = True  # every 0.4 m
    inside = near_obstacles(occupied, 0.1)
    assert inside[9:12, 5:30].all() and not inside[13:].any() and not inside[:, 32:].any()
    occupied = np.zeros((40, 40), np.bool_)
    occupied[10, [5, 14]] = True  # a door of 0.8 m
    assert not near_obstacles(occupied, 0.1)[10, 7:13].any()


def test_an_ensemble_of_units() -> None:
    both = UnitEnsemble([Toy("chair"), Toy("bed")])
    assert both.spec.categories == ("chair", "bed") and both.spec.thresholds == (0.5, 0.5)
    rgb, depth, pose = frames()[0]
    update = SemanticMapper(both).update(rgb, depth, pose)
    assert update.probabilities.shape == (2, 31, 31)
    with pytest.raises(UserError, match="categories .*'chair', 'chair'"):
        UnitEnsemble([Toy("chair"), Toy("chair")])
    with pytest.raises(UserError, match="got the ego"):
        UnitEnsemble([Toy("chair"), Toy("bed", ego=EgoGrid(0.12, 33))])


def test_unit_specs_are_read_from_json_and_invalid_ones_are_refused() -> None:
    spec = Toy("chair", "bed").spec
    assert UnitSpec.from_json(spec.to_json(look_once=True), "x") == spec  # an entry of earlier versions
    for change, message in (
        (('"version": 2', '"version": 1'), "got version 1"),
        (("[0.5, 0.5]", "[0.5]"), "got 1 thresholds"),
        (("[0.5, 0.5]", "[0.5, NaN]"), "thresholds: got nan"),
        (("[0.5, 0.5]", "[0.5, 1.5]"), "thresholds: got 1.5"),
        (('"cells": 31', '"cells": 9000000'), "cells: got 9000000"),
        (('"width": 48', '"width": 4000000'), "width: got 4000000"),
        (('"chair"', '"../chair"'), "got the category '../chair'"),
        (('"chair"', '"map"'), "got the category 'map'"),
        (('"ego"', '"egg"'), "x: the unit specification cannot be read"),
    ):
        with pytest.raises(UserError, match=message):
            UnitSpec.from_json(spec.to_json().replace(*change), "x")
    with pytest.raises(UserError, match="x: the unit specification cannot be read"):
        UnitSpec.from_json("[1", "x")


def test_intrinsics_of_a_real_sensor() -> None:
    """640 x 480 with an off-centre axis: the room's floor appears where it is."""
    k = Intrinsics(640, 480, 330.0, 332.0, 315.0, 236.0)
    ideal = Camera(640, 480, 2 * float(np.arctan(320 / 330.0)), 1.25)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mapper, plain = SemanticMapper(Toy(), RgbdCamera(k)), SemanticMapper(Toy())
        for rgb, depth, pose in frames(ideal):
            mapper.update(rgb, depth, pose)
        for frame in frames():
            plain.update(*frame)
    one, other = mapper.maps.known, plain.maps.known
    assert one.shape == other.shape
    assert (one & other).sum() / one.sum() > 0.85  # it sees less of what is near: its field of view is lower
    assert (one & other).sum() / other.sum() > 0.6
