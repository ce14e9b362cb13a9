"""Contract of all scene sources."""

import dataclasses
import pickle
from collections.abc import Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import cv2
import numpy as np
import pytest

from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band
from imagination.ground_truth.scene_maps import GroundTruthSpec, build
from imagination.scenes.categories import CategoryTable
from imagination.scenes.renderer import Image, renderer_of
from imagination.scenes.scene import Scene
from imagination.scenes.source import SPLITS, SceneSource, Split
from imagination.utils.errors import UserError
from imagination.views.pose_samplers import sample_poses
from tests.conftest import ROOT
from tests.helpers.fake_habitat import install
from tests.helpers.scene_sources import NEEDS, SOURCES, configured

EXAMPLE = "imagination_example/rooms.py", "conf/data/scenes/box_rooms.yaml"

CAMERA = Camera.from_degrees(48, 48, 90.0, 1.25)


@pytest.fixture(scope="module", params=SOURCES)
def source(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SceneSource]:
    if request.param in NEEDS:
        pytest.importorskip(NEEDS[request.param], reason=f"{request.param} is read by {NEEDS[request.param]}")
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "habitat":
            install(patch)
        yield SOURCES[request.param](tmp_path_factory.mktemp(request.param))


@pytest.fixture(scope="module")
def scene(source: SceneSource) -> Scene:
    return source.load(source.scenes("train")[0])


@pytest.fixture(scope="module")
def images(scene: Scene) -> list[tuple[Pose, Image]]:
    return rendered(scene)


def rendered(scene: Scene) -> list[tuple[Pose, Image]]:
    """Render a scene from random poses."""
    renderer = renderer_of(scene)
    poses = sample_poses(scene.free_space, 24, np.random.default_rng(5))
    return [(pose, renderer.render(CAMERA, CAMERA.to_world(pose, scene.floor_height))) for pose in poses]


def test_without_colour_the_rest_is_the_same(scene: Scene, images: list[tuple[Pose, Image]]) -> None:
    for pose, image in images[:4]:
        camera_to_world = CAMERA.to_world(pose, scene.floor_height)
        plain = renderer_of(scene).render(CAMERA, camera_to_world, colour=False)
        np.testing.assert_array_equal(plain.depth, image.depth)
        np.testing.assert_array_equal(plain.instance, image.instance)
        assert image.rgb.any()


def test_the_example_source_has_the_length_in_the_docs() -> None:
    files = [ROOT / "tests/helpers/example_plugin" / path for path in EXAMPLE]
    lines = sum(len(path.read_text().splitlines()) for path in files)
    text = (ROOT / "docs" / "how-to" / "scenes.md").read_text()
    assert lines < 60 and f"{lines} lines with its config" in text


def test_the_pictures_of_the_docs_can_be_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = spec_from_file_location("scene_sources", ROOT / "docs" / "scene_sources.py")
    assert spec is not None and spec.loader is not None
    page = module_from_spec(spec)
    spec.loader.exec_module(page)
    monkeypatch.setattr(page, "PICTURES", tmp_path)
    page.main(["box_rooms"])
    picture = cv2.imread(str(tmp_path / "source-box_rooms.png"))
    assert picture is not None and picture.std() > 10
    text = (ROOT / "docs" / "how-to" / "scenes.md").read_text()
    assert all(f"(../pictures/source-{name}.png)" in text for name in SOURCES)


def points_of(pose: Pose, image: Image, scene: Scene) -> np.ndarray:
    """Back-project the pixels of an image to world points."""
    v, u = np.mgrid[:48, :48] + 0.5
    x, y = (u - 24) / 24 * image.depth, (v - 24) / 24 * image.depth
    cos, sin = np.cos(pose.theta), np.sin(pose.theta)
    forward, left, up = image.depth, -x, -y + 1.25
    return np.stack(
        [pose.x + cos * forward - sin * left, pose.y + sin * forward + cos * left, up + scene.floor_height],
        axis=-1,
    )


def test_the_source_has_the_interface_and_is_picklable(source: SceneSource) -> None:
    assert isinstance(source, SceneSource)
    copy = pickle.loads(pickle.dumps(source))
    assert copy.scenes("train") == source.scenes("train")
    name = source.scenes("train")[0]
    assert copy.fingerprint(name) == source.fingerprint(name)


def test_identities_of_scenes_differ_and_name_the_source(source: SceneSource, tmp_path: Path) -> None:
    names = [name for split in SPLITS for name in scenes_of(source, split)]
    identities = [source.identity(name) for name in names]
    assert len(set(identities)) == len(names)
    assert all(identity.startswith(f"{source.name} ") for identity in identities)
    assert pickle.loads(pickle.dumps(source)).identity(names[0]) == identities[0]
    assert str(tmp_path.parent) not in "".join(identities)


def scenes_of(source: SceneSource, split: Split) -> list[str]:
    """Return the scenes of a split; none of an empty split, as of a data set with one scan."""
    try:
        return source.scenes(split)
    except UserError:
        return []


def test_instance_ids_in_images_belong_to_objects(scene: Scene, images: list[tuple[Pose, Image]]) -> None:
    known = {0, *(obj.instance for obj in scene.objects)}
    seen = set(np.unique(np.concatenate([image.instance.ravel() for _, image in images])).tolist()) - {-1}
    assert seen <= known and len(seen) > 1
    assert len({obj.instance for obj in scene.objects}) == len(scene.objects)
    for _, image in images:
        np.testing.assert_array_equal(image.instance == -1, image.depth == 0)


def test_depth_agrees_with_the_mesh(scene: Scene, images: list[tuple[Pose, Image]]) -> None:
    if len(scene.mesh.faces) == 0:
        pytest.skip("the scene brings its own renderer and no mesh")
    corners = scene.mesh.vertices[scene.mesh.faces].astype(np.float64)
    rng = np.random.default_rng(0)
    for pose, image in images[:3]:
        origin = np.array([pose.x, pose.y, scene.floor_height + 1.25])
        points = points_of(pose, image, scene)
        for row, column in rng.integers(0, 48, (12, 2)).tolist():
            if image.depth[row, column] > 0:
                direction = points[row, column] - origin
                assert nearest_hit(origin, direction, corners) == pytest.approx(
                    1.0, abs=1e-3 / np.linalg.norm(direction)
                )


def nearest_hit(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray) -> float:
    """Return the distance of the nearest hit of a ray in lengths of its direction (Moeller-Trumbore)."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, second)
    scale = (first * across).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origin - corners[:, 0]
        u = (offset * across).sum(axis=1) / scale
        other = np.cross(offset, first)
        v = (other @ direction) / scale
        t = (second * other).sum(axis=1) / scale
    edge = 1e-6
    hit = (u >= -edge) & (v >= -edge) & (u + v <= 1 + edge) & (t > 0) & np.isfinite(t)
    return float(t[hit].min())


def test_boxes_contain_the_visible_points_of_their_objects(
    scene: Scene, images: list[tuple[Pose, Image]]
) -> None:
    boxes = {obj.instance: obj.box for obj in scene.objects}
    checked = 0
    for pose, image in images:
        points = points_of(pose, image, scene)
        for instance in set(np.unique(image.instance).tolist()) - {-1, 0}:
            box = boxes[instance]
            offset = points[image.instance == instance] - np.array(box.centre)
            cos, sin = np.cos(box.yaw), np.sin(box.yaw)
            x, y = offset[:, 0] * cos + offset[:, 1] * sin, offset[:, 1] * cos - offset[:, 0] * sin
            inside = np.abs(np.stack([x, y, offset[:, 2]], axis=-1)) <= np.array(box.size) / 2 + 0.003
            assert inside.all(), (instance, box)
            checked += len(offset)
    assert checked > 50


def test_free_space_is_free(scene: Scene) -> None:
    """No part of the mesh 0.15 to 1.2 m above the floor is closer to a free cell than the radius of the robot."""
    if len(scene.mesh.faces) == 0:
        pytest.skip("the scene brings its own renderer and no mesh")
    corners = scene.mesh.vertices[scene.mesh.faces].astype(np.float64)
    weights = np.random.default_rng(1).dirichlet([1, 1, 1], 30)
    points = (weights @ corners).reshape(-1, 3)
    height = points[:, 2] - scene.floor_height
    obstacles = points[(height > 0.15) & (height < 1.2), :2]
    free = scene.free_space.grid.to_points(np.argwhere(scene.free_space.mask))
    assert len(free) > 10
    for position in free[:: max(len(free) // 60, 1)]:
        assert np.hypot(*(obstacles - position).T).min() >= 0.2 - 1e-3


def test_ground_truth_is_not_empty(scene: Scene, tmp_path: Path) -> None:
    table = CategoryTable.from_config(dict(configured(tmp_path).categories))
    spec = GroundTruthSpec(24.12, 0.12, 0.5, 0.6, Band(0.2, 1.5), dataclasses.replace(CAMERA))
    ground_truth = build(scene, renderer_of(scene), spec, table)
    for layer, name in enumerate(table.names):
        if scene.of_category(name):
            assert ground_truth.truth[layer].any(), name
    assert ground_truth.truth.any() and ground_truth.occupied.any()


def test_the_same_name_gives_the_same_views(
    source: SceneSource, scene: Scene, images: list[tuple[Pose, Image]]
) -> None:
    again = source.load(scene.name)
    np.testing.assert_array_equal(again.mesh.vertices, scene.mesh.vertices)
    np.testing.assert_array_equal(again.free_space.mask, scene.free_space.mask)
    assert again.objects == scene.objects
    renderer = renderer_of(again)
    for pose, image in images[:3]:
        other = renderer.render(CAMERA, CAMERA.to_world(pose, again.floor_height))
        for first, second in zip(image, other, strict=True):
            np.testing.assert_array_equal(first, second)
