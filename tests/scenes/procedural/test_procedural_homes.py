"""Procedural homes as scenes: deterministic, plausibly furnished, and accessible to the robot."""

import pickle
from functools import cache

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy import ndimage
from scipy.spatial import cKDTree

from imagination.scenes.categories import Category, CategoryTable
from imagination.scenes.procedural.furniture.styles import families_of
from imagination.scenes.procedural.source import ProceduralHomes
from imagination.scenes.scene import Scene, SceneObject
from imagination.scenes.source import SPLITS, SceneSource, SpareScenes
from imagination.utils.errors import UserError

ALIASES = {
    "chair": ["chair", "office_chair", "armchair"],
    "bed": ["double_bed", "single_bed", "bunk_bed"],
    "table": ["dining_table", "desk", "coffee_table", "side_table"],
}
TABLE = CategoryTable([Category(name, (0, 0, 0), {"procedural": labels}) for name, labels in ALIASES.items()])
RADIUS = 0.2
DOWN = np.array([0.0, 0.0, -1.0])


def homes(seed: int = 0, categories: CategoryTable = TABLE, **changes: object) -> ProceduralHomes:
    splits = {"train": 2, "val": 1, "test": 2}
    return ProceduralHomes(seed, splits, categories, **{"robot_radius": RADIUS, **changes})


SOURCE = homes()
NAMES = [name for split in SPLITS for name in SOURCE.scenes(split)]
load = cache(SOURCE.load)


@pytest.fixture(params=NAMES)
def scene(request: pytest.FixtureRequest) -> Scene:
    return load(request.param)


@pytest.fixture
def scenes() -> list[Scene]:
    return [load(name) for name in NAMES]


def vertices_of(scene: Scene, instance: int) -> np.ndarray:
    return scene.mesh.vertices[scene.mesh.faces[scene.mesh.face_instance == instance]].reshape(-1, 3)


def in_box_frame(obj: SceneObject, points: np.ndarray) -> np.ndarray:
    """Return points in the frame of the box of an object."""
    cos, sin = np.cos(obj.box.yaw), np.sin(obj.box.yaw)
    relative = points - np.array(obj.box.centre)[: points.shape[1]]
    turned = relative.copy()
    turned[:, 0] = cos * relative[:, 0] + sin * relative[:, 1]
    turned[:, 1] = -sin * relative[:, 0] + cos * relative[:, 1]
    return turned


def overlapping(one: SceneObject, other: SceneObject, tolerance: float = 0.004) -> bool:
    """Return whether two boxes overlap by more than `tolerance` metres in every direction (by dense sampling)."""
    tops = [obj.box.centre[2] + obj.box.size[2] / 2 for obj in (one, other)]
    bottoms = [obj.box.centre[2] - obj.box.size[2] / 2 for obj in (one, other)]
    reach = (np.hypot(*one.box.size[:2]) + np.hypot(*other.box.size[:2])) / 2
    far = np.hypot(*(np.array(one.box.centre) - other.box.centre)[:2]) > reach
    if far or min(tops) - max(bottoms) < tolerance:
        return False
    samples = np.linspace(-0.5, 0.5, 60)
    grid = np.stack(np.meshgrid(samples, samples), axis=-1).reshape(-1, 2) * (
        np.array(one.box.size[:2]) - 2 * tolerance
    )
    cos, sin = np.cos(one.box.yaw), np.sin(one.box.yaw)
    points = grid @ np.array([[cos, sin], [-sin, cos]]) + one.box.centre[:2]
    inside = np.abs(in_box_frame(other, points)) < np.array(other.box.size[:2]) / 2 - tolerance
    return bool(inside.all(axis=1).any())


def overlaps(scene: Scene) -> list[tuple[SceneObject, SceneObject]]:
    objects = [obj for obj in scene.objects if obj.label != "rug"]
    return [
        (a, b) for n, a in enumerate(objects) for b in objects[:n] if overlapping(a, b) or overlapping(b, a)
    ]


def first_hits(faces: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the distance of rays to the faces given by their corners; huge without a hit."""
    embree = EmbreeScene()
    TriangleMesh(embree, faces)
    rays = np.broadcast_to(np.asarray(directions, np.float32), origins.shape)
    return embree.run(origins.astype(np.float32), np.ascontiguousarray(rays), query="DISTANCE")


def faces_of(scene: Scene) -> np.ndarray:
    return scene.mesh.vertices[scene.mesh.faces]


def test_source_fulfils_the_interface() -> None:
    assert isinstance(SOURCE, SceneSource)
    assert SOURCE.scenes("val") == ["val_0000"]
    assert SOURCE.categories() == ("chair", "bed", "table")


def test_a_home_depends_on_seed_split_and_number_alone() -> None:
    again = pickle.loads(pickle.dumps(homes(robot_radius=RADIUS))).load("train_0001")
    scene = load("train_0001")
    np.testing.assert_array_equal(again.mesh.vertices, scene.mesh.vertices)
    np.testing.assert_array_equal(again.mesh.face_uv, scene.mesh.face_uv)
    np.testing.assert_array_equal(again.free_space.mask, scene.free_space.mask)
    assert again.objects == scene.objects
    for one, other in zip(again.mesh.materials, scene.mesh.materials, strict=True):
        assert one.colour == other.colour
        np.testing.assert_array_equal(one.texture, other.texture)
    assert homes(seed=1).load("train_0001").mesh.vertices.shape != scene.mesh.vertices.shape


def test_fingerprint_differs_between_homes() -> None:
    prints = [SOURCE.fingerprint(name) for name in NAMES]
    prints += [homes(seed=1).fingerprint("train_0000"), homes(robot_radius=0.25).fingerprint("train_0000")]
    assert len(set(prints)) == len(prints)
    assert homes().fingerprint("train_0000") == prints[0]


def test_splits_share_no_model(scenes) -> None:
    models = {
        split: {o.model for s in scenes if s.name.startswith(split) for o in s.objects if o.category}
        for split in SPLITS
    }
    assert not models["train"] & models["test"]
    assert not models["train"] & models["val"]
    assert not models["val"] & models["test"]


def test_spare_homes_have_training_furniture_and_are_in_no_split() -> None:
    assert isinstance(SOURCE, SpareScenes)
    names = SOURCE.spare(2)
    assert names == ["known_0000", "known_0001"] and not set(names) & set(NAMES)
    home = load(names[0])
    families = families_of("train")
    styled = [obj for obj in home.objects if obj.label in families]
    assert styled and all(obj.model.partition("/")[0] in families[obj.label] for obj in styled)
    assert len({SOURCE.fingerprint(name) for name in [*names, *NAMES]}) == 2 + len(NAMES)
    assert len(home.mesh.vertices) not in [len(load(name).mesh.vertices) for name in NAMES]


def test_every_home_has_chairs_tables_and_beds(scene: Scene) -> None:
    assert all(scene.of_category(category) for category in ("chair", "table", "bed"))
    assert not any(obj.category for obj in scene.objects if obj.label in ("stool", "sofa", "nightstand"))


def test_size_of_the_mesh_and_place_of_the_home(scene: Scene) -> None:
    mesh = scene.mesh
    assert 8_000 < len(mesh.faces) < 100_000
    building = vertices_of(scene, 0)
    middle = (building.min(axis=0) + building.max(axis=0)) / 2
    np.testing.assert_allclose(middle[:2], 0, atol=1e-4)
    np.testing.assert_allclose(
        [building[:, 2].min(), building[:, 2].max()], [0, scene.ceiling_height], atol=1e-4
    )
    assert mesh.face_material.max() < len(mesh.materials)
    assert set(np.unique(mesh.face_instance)) == {0} | {obj.instance for obj in scene.objects}


def test_floor_area_is_in_range(scene: Scene) -> None:
    corners = scene.mesh.vertices[scene.mesh.faces[scene.mesh.face_instance == 0]]
    floor = corners[(np.abs(corners[..., 2]) < 1e-4).all(axis=1)].astype(float)
    up = np.cross(floor[:, 1] - floor[:, 0], floor[:, 2] - floor[:, 0])[:, 2]
    assert 40 <= up[up > 0].sum() / 2 <= 155  # with the thresholds of doors


def test_boxes_fit_their_meshes_tightly(scene: Scene) -> None:
    for obj in scene.objects:
        points = in_box_frame(obj, vertices_of(scene, obj.instance).astype(float))
        np.testing.assert_allclose(points.min(axis=0), -np.array(obj.box.size) / 2, atol=1e-4)
        np.testing.assert_allclose(points.max(axis=0), np.array(obj.box.size) / 2, atol=1e-4)


def test_furniture_does_not_overlap(scene: Scene) -> None:
    """Except chairs under tables (which also enter the boxes of objects on them), and objects on top of others."""
    for one, other in overlaps(scene):
        low = max((one, other), key=lambda obj: obj.box.centre[2] - obj.box.size[2] / 2)
        tucked = {"chair", "table"} == {one.category, other.category}
        on_top = low.box.centre[2] - low.box.size[2] / 2 > 0.25
        assert tucked or on_top, (scene.name, one.label, other.label)


def test_no_chair_touches_the_table_it_is_under(scenes) -> None:
    tucked = 0
    for scene in scenes:
        for pair in overlaps(scene):
            chair, table = sorted(pair, key=lambda obj: obj.category or "")
            if (chair.category, table.category) != ("chair", "table"):
                continue
            tucked += 1
            points = vertices_of(scene, chair.instance)
            top = table.box.centre[2] + table.box.size[2] / 2
            high = points[points[:, 2] > top]
            under = faces_of(scene)[scene.mesh.face_instance == table.instance]
            assert len(high) == 0 or first_hits(under, high, DOWN).min() > 10
            if table.model.startswith("corner_desk"):
                continue  # the seat is inside its box
            # its front is the end under the table
            front = np.array([-np.sin(chair.box.yaw), np.cos(chair.box.yaw)]) * chair.box.size[1] / 2
            ends = np.array(chair.box.centre[:2]) + np.stack([front, -front])
            reach = (np.abs(in_box_frame(table, ends)) / (np.array(table.box.size[:2]) / 2)).max(axis=1)
            assert reach[0] <= reach[1]
    assert tucked > 2 * len(scenes)


def test_most_homes_have_chairs_under_tables(scenes) -> None:
    pairs = [{frozenset((a.category, b.category)) for a, b in overlaps(scene)} for scene in scenes]
    assert sum(frozenset(("chair", "table")) in categories for categories in pairs) >= 0.75 * len(scenes)


def test_beds_stand_with_their_backs_to_a_wall(scene: Scene) -> None:
    for bed in scene.of_category("bed"):
        back = -np.array([-np.sin(bed.box.yaw), np.cos(bed.box.yaw)])
        origin = np.array([*(np.array(bed.box.centre[:2]) + back * (bed.box.size[1] / 2 + 0.001)), 0.15])
        assert first_hits(faces_of(scene), origin[None], np.array([*back, 0.0]))[0] < 0.1


def test_free_space_is_connected_and_clear_of_furniture(scene: Scene) -> None:
    free = scene.free_space
    assert ndimage.label(free.mask)[1] == 1
    centres = free.grid.to_points(np.argwhere(free.mask))
    assert len(centres) * free.grid.resolution**2 > 5
    points = scene.mesh.vertices[(scene.mesh.vertices[:, 2] > 0.06) & (scene.mesh.vertices[:, 2] < 1.49)]
    assert cKDTree(points[:, :2]).query(centres)[0].min() > RADIUS - 0.04
    # looking down from the robot's head, free cells show the floor or a rug, never furniture
    above = np.column_stack([centres, np.full(len(centres), 1.49)])
    assert (
        first_hits(faces_of(scene)[(faces_of(scene)[..., 2] < 1.5).all(axis=1)], above, DOWN).min()
        > 1.49 - 0.05
    )


def test_no_ray_leaves_the_home(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    cells = np.argwhere(scene.free_space.mask)
    places = scene.free_space.grid.to_points(cells[rng.integers(len(cells), size=4000)])
    origins = np.column_stack([places, rng.uniform(0.1, 2.0, 4000)])
    directions = rng.standard_normal((4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert first_hits(faces_of(scene), origins, directions).max() < 30


def test_bad_input_is_refused_with_what_is_allowed() -> None:
    with pytest.raises(UserError, match=r"got 'train_0002'.*train_0000 to train_0001"):
        SOURCE.load("train_0002")
    with pytest.raises(UserError, match="scene: got 'attic'"):
        SOURCE.fingerprint("attic")
    with pytest.raises(UserError, match=r"splits\.val: got -1"):
        ProceduralHomes(0, {"train": 1, "val": -1, "test": 1}, TABLE, RADIUS)
    with pytest.raises(UserError, match="expected train, val, test"):
        ProceduralHomes(0, {"train": 1}, TABLE, RADIUS)
    with pytest.raises(UserError, match="split val: got 0 homes"):
        ProceduralHomes(0, {"train": 1, "val": 0, "test": 1}, TABLE, RADIUS).scenes("val")
    with pytest.raises(UserError, match="robot_radius: got 2.0"):
        homes(robot_radius=2.0)
    with pytest.raises(UserError, match="seed: got -4"):
        homes(seed=-4)


def test_labels_that_do_not_exist_and_categories_without_labels_are_refused() -> None:
    misspelt = CategoryTable([Category("chair", (0, 0, 0), {"procedural": ["chiar"]})])
    with pytest.raises(UserError, match=r"got labels chiar of procedural.*armchair"):
        homes(categories=misspelt)
    lamp = CategoryTable([*TABLE, Category("lamp", (0, 0, 0), {"replica": ["lamp"]})])
    with pytest.raises(UserError, match=r"category lamp: got no labels.*floor_lamp"):
        homes(categories=lamp, required=["lamp"])
    with pytest.raises(UserError, match=r"category: got 'sofa'"):
        homes(required=["sofa"])
