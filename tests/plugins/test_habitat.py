"""Habitat: conversion of frames, and the scene source with a fake simulator, or the real one if it is installed."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose
from imagination.scenes.renderer import Renderer, renderer_of
from imagination.scenes.scene import OrientedBox
from imagination.scenes.source import SceneSource
from imagination.utils.errors import UserError
from tests.helpers.fake_habitat import FLOOR, Fake, install
from tests.helpers.scene_sources import source

from imagination_habitat import frames  # isort: skip  # importable since scene_sources activates the plugins
from imagination_habitat.doctor import TRIAL  # isort: skip
from imagination_habitat.simulator import SIMULATORS  # isort: skip

SCENES = "data.scenes.scenes={train: [a, b], val: [c], test: [d]}"


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[Fake]:
    yield install(monkeypatch)
    SIMULATORS.close()


@pytest.fixture
def habitat(fake: Fake, tmp_path: Path) -> SceneSource:
    return source(tmp_path, "data/scenes=habitat", SCENES)


def test_points_survive_a_round_trip() -> None:
    assert frames.from_habitat(np.array([1.0, 2.0, 3.0])).tolist() == [1.0, -3.0, 2.0]
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(frames.to_habitat(frames.from_habitat(points)), points)
    assert np.linalg.det(frames.FROM_HABITAT) == pytest.approx(1.0)


def test_a_robot_facing_x_rotates_habitats_camera_by_minus_90_degrees() -> None:
    """Habitat's camera faces -z, which is our +y; +90 degrees about its y face -x, so +x needs -90."""
    camera = Camera.from_degrees(48, 48, 90.0, 1.25)
    position, rotation = frames.camera_state(camera.to_world(Pose(1.0, 2.0, 0.0), 0.5))
    np.testing.assert_allclose(position, [1.0, 1.75, -2.0])
    np.testing.assert_allclose(rotation, [np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0], atol=1e-12)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternions_are_those_of_scipy(numbers: list[float]) -> None:
    rotation = Rotation.from_quat(numbers)
    x, y, z, w = rotation.as_quat()
    ours = np.array(frames.quaternion(rotation.as_matrix()))
    np.testing.assert_allclose(ours * np.sign(ours @ [w, x, y, z]), [w, x, y, z], atol=1e-9)
    np.testing.assert_allclose(
        frames.rotation_matrix(rotation.as_quat().tolist()), rotation.as_matrix(), atol=1e-9
    )


@given(st.floats(-3.1, 3.1))
def test_an_upright_box_keeps_its_size_and_yaw(yaw: float) -> None:
    rotation = [0.0, float(np.sin(yaw / 2)), 0.0, float(np.cos(yaw / 2))]  # about Habitat's y
    box = frames.upright_box([1.0, 0.5, -2.0], [0.7, 0.5, 0.2], rotation)
    expected = OrientedBox((1.0, 2.0, 0.5), (1.4, 0.4, 1.0), yaw).footprint()
    distance = np.linalg.norm(box.footprint()[:, None] - expected[None], axis=2).min(axis=0)
    assert distance.max() < 1e-6
    assert box.size[2] == pytest.approx(1.0) and box.centre[2] == pytest.approx(0.5)


def test_rows_of_the_top_down_view_run_against_y() -> None:
    view = np.zeros((3, 4), bool)
    view[0, 1] = True  # smallest z, second x
    grid, mask = frames.free_grid(view, [2.0, 0.0, 5.0], 0.5)
    (x, y), *more = grid.to_points(np.argwhere(mask)).tolist()
    assert not more and (x, y) == (2.75, -5.25)


def test_images_are_those_of_the_room(habitat: SceneSource, fake: Fake) -> None:
    scene = habitat.load("a")
    assert scene.floor_height == pytest.approx(FLOOR)  # the navmesh is 0.05 m higher
    ours, theirs = Renderer(fake.room.mesh, fake.room.lighting), renderer_of(scene)
    camera = Camera.from_degrees(40, 32, 70.0, 1.0, pitch=15.0)
    for x, y, theta in ((1.0, 2.0, 0.0), (1.3, 1.6, 2.0), (0.6, 2.2, -1.0)):
        pose = camera.to_world(Pose(x, y, theta), FLOOR)
        expected, image = ours.render(camera, pose), theirs.render(camera, pose)
        assert (np.abs(image.depth - expected.depth) < 1e-3).mean() > 0.998
        assert (image.instance == expected.instance).mean() > 0.998
        assert (image.rgb == expected.rgb).mean() > 0.99


def test_one_simulator_serves_all_scenes(habitat: SceneSource, fake: Fake) -> None:
    habitat.load("a")
    habitat.load("b")
    assert (fake.started, fake.changed) == (1, 1)


@pytest.mark.parametrize(
    ("defect", "message"),
    [
        ("blind", "scene a: .* saw none of 4 objects"),
        ("unnamed", "scene a: .*no named object"),
        ("no_floor", "scene a: .*no floor"),
    ],
)
def test_a_scene_without_objects_or_floor_is_refused(
    habitat: SceneSource, fake: Fake, defect: str, message: str
) -> None:
    setattr(fake, defect, True)
    with pytest.raises(UserError, match=message):
        habitat.load("a")


def test_without_the_simulator_the_message_names_the_installation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "habitat_sim", None)
    with pytest.raises(UserError, match="conda install habitat-sim"):
        source(tmp_path, "data/scenes=habitat", SCENES).load("a")
    with pytest.raises(UserError, match=r"data\.scenes\.dataset: got missing\.json"):
        source(tmp_path, "data/scenes=habitat", SCENES, "data.scenes.dataset=missing.json")
    with pytest.raises(UserError, match=r"data\.scenes\.scenes\.train: got no scenes"):
        source(tmp_path, "data/scenes=habitat").scenes("train")


def test_the_doctors_trial_renders(fake: Fake, capsys: pytest.CaptureFixture[str]) -> None:
    exec(TRIAL)
    assert capsys.readouterr().out == "usable 0.3.3\n" and fake.renders == 1


@pytest.mark.skipif(find_spec("habitat_sim") is None, reason="habitat-sim is not installed (conda only)")
def test_the_real_simulator_can_be_created() -> None:
    from imagination_habitat.doctor import examine

    assert [finding.good for finding in examine()] == [True]


def test_a_scene_file_is_recognised_where_it_was_moved(fake: Fake, tmp_path: Path) -> None:
    paths = [tmp_path / folder / "mesh.glb" for folder in ("one", "two")]
    for path in paths:
        path.parent.mkdir()
        path.write_text(path.parent.name)

    def habitat(train: Path, test: Path) -> SceneSource:
        return source(
            tmp_path,
            "data/scenes=habitat",
            f"data.scenes.scenes={{train: [{train}], val: [a], test: [{test}]}}",
        )

    before = habitat(*paths)
    one, two = (before.identity(str(path)) for path in paths)
    assert one != two and one.startswith("habitat ") and str(tmp_path) not in one
    moved = tmp_path / "moved.glb"
    paths[0].rename(moved)
    assert habitat(paths[1], moved).identity(str(moved)) == one


def test_a_scene_in_two_splits_is_refused(fake: Fake, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="data.scenes.scenes: got a more than once"):
        source(tmp_path, "data/scenes=habitat", "data.scenes.scenes={train: [a, b], val: [c], test: [a]}")
