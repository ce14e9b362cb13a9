"""Scanned buildings: reading of tiny buildings, floors, splits, and messages for malformed files."""

import io
import json
import logging
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from imagination.geometry.camera import Camera
from imagination.ground_truth.scene_maps import needed_extent
from imagination.scenes.renderer import renderer_of
from imagination.scenes.scene import Scene
from imagination.scenes.source import SceneSource
from imagination.utils.errors import UserError
from imagination.views.pose_samplers import sample_poses
from tests.conftest import ROOT
from tests.helpers.scanned_buildings import (
    COLOURS,
    ply,
    soup,
    tiny_building,
    write_hm3d,
    write_matterport,
    write_replica,
)
from tests.helpers.scene_sources import source

from imagination_scans.building import colour_texture, upright_box  # isort: skip
from imagination_scans.hm3d import HM3D  # isort: skip
from imagination_scans.matterport3d import SPLIT_LISTS  # isort: skip
from imagination_scans.replica import Replica  # isort: skip
from imagination_scans.source import _building  # isort: skip

WRITERS: dict[str, Callable[[Path], Path]] = {
    "matterport3d": write_matterport,
    "hm3d": write_hm3d,
    "replica": write_replica,
}


def read(tmp_path: Path, name: str, *overrides: str) -> SceneSource:
    return source(tmp_path, f"data/scenes={name}", f"data.scenes.folder={tmp_path}", *overrides)


@pytest.mark.parametrize("name", WRITERS)
def test_a_building_is_read_back(tmp_path: Path, name: str) -> None:
    WRITERS[name](tmp_path)
    found = read(tmp_path, name)
    (scene_name,) = found.scenes("train")
    scene, (room,) = found.load(scene_name), tiny_building()
    assert scene.floor_height == pytest.approx(0.6, abs=1e-3)
    assert scene.ceiling_height == pytest.approx(room.ceiling_height, abs=0.03)
    assert len(scene.mesh.faces) == len(room.mesh.faces)
    by_label = {obj.label: obj for obj in scene.objects}
    for obj in room.objects:
        box = by_label[obj.label].box
        assert by_label[obj.label].category == obj.category
        np.testing.assert_allclose(box.centre, obj.box.centre, atol=0.01)
        assert sorted(box.size[:2]) == pytest.approx(sorted(obj.box.size[:2]), abs=0.01)
        gap = np.linalg.norm(box.footprint()[:, None] - obj.box.footprint()[None], axis=2).min(axis=1)
        assert gap.max() < 0.02
    areas = []
    for mesh in (scene.mesh, room.mesh):
        corners = mesh.vertices[mesh.faces]
        areas.append(np.linalg.norm(np.cross(*np.diff(corners, axis=1).swapaxes(0, 1)), axis=1).sum() / 2)
    assert areas[0] == pytest.approx(areas[1], rel=1e-5)


def test_matterport_for_habitat_is_read(tmp_path: Path) -> None:
    write_matterport(tmp_path, habitat=True)
    scene = read(tmp_path, "matterport3d").load("17DRP5sb8fy_0")
    assert {obj.label for obj in scene.objects} == {"chair", "bed", "table", "lamp"}


def test_several_floors_are_several_scenes(tmp_path: Path) -> None:
    write_matterport(tmp_path, floors=2)
    found = read(tmp_path, "matterport3d")
    names = found.scenes("train")
    assert names == ["17DRP5sb8fy_0", "17DRP5sb8fy_1"]
    lower, upper = (found.load(name) for name in names)
    assert upper.floor_height - lower.floor_height == pytest.approx(3.0, abs=1e-3)
    for scene in (lower, upper):
        assert len(scene.objects) == 4 and scene.free_space.mask.any()
        low, high = scene.floor_height - 0.35, scene.ceiling_height + 0.35
        assert scene.mesh.vertices[:, 2].min() > low and scene.mesh.vertices[:, 2].max() < high


def test_a_floor_larger_than_the_map_is_skipped_with_a_message(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_matterport(tmp_path)
    (room,) = tiny_building()
    needed = needed_extent(room)
    for largest, usable in ((needed - 0.2, False), (needed + 0.2, True)):
        found = read(tmp_path, "matterport3d", f"data.scenes.largest={largest}")
        if usable:
            assert found.scenes("train") == ["17DRP5sb8fy_0"]
            continue
        with (
            caplog.at_level(logging.WARNING),
            pytest.raises(UserError, match="split train: none of 1 buildings"),
        ):
            found.scenes("train")
        assert "skipped: scene 17DRP5sb8fy_0: needs a map of" in caplog.text


def test_an_unusable_floor_is_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The upper floor has no object, or a lid 0.3 m above it; the lower floor is used."""
    house = write_matterport(tmp_path, floors=2)
    path = house.with_suffix(".ply")
    vertices, quads, owner, colour = soup(tiny_building(2))
    rgb = np.repeat(colour, 4, axis=0)
    lower = np.where(owner < 4, owner, -1)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    lid = np.array(
        [[x, y, 3.9] for x, y in ((low[0], low[1]), (low[0], high[1]), high[:2], (high[0], low[1]))]
    )
    cases = [
        (vertices, quads, rgb, lower, "no annotated object"),
        (
            np.concatenate([vertices, lid.astype(np.float32)]),
            np.concatenate([quads, len(vertices) + np.arange(4)[None]]),
            np.concatenate([rgb, np.zeros((4, 3), np.uint8)]),
            np.append(owner, -1),
            "no free cell",
        ),
    ]
    for points, polygons, colours, owners, message in cases:
        ply(path, points, polygons, colours, {"segment_id": owners})
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            assert read(tmp_path, "matterport3d").scenes("train") == ["17DRP5sb8fy_0"]
        assert "skipped: scene 17DRP5sb8fy_1" in caplog.text and message in caplog.text


def test_official_splits() -> None:
    lists = {path.stem: path.read_text().split() for path in SPLIT_LISTS.glob("*.txt")}
    buildings = [name for names in lists.values() for name in names]
    assert {stem: len(names) for stem, names in lists.items()} == {
        "matterport3d_train": 61,
        "matterport3d_val": 11,
        "matterport3d_test": 18,
    }
    assert len(set(buildings)) == 90


def test_lists_in_the_folder_have_precedence(tmp_path: Path) -> None:
    write_matterport(tmp_path)
    write_matterport(tmp_path, "mine")
    (tmp_path / "scenes_test.txt").write_text("mine\n")
    found = read(tmp_path, "matterport3d")
    assert found.scenes("test") == ["mine_0"]
    with pytest.raises(UserError, match="split train: none of 2 buildings"):
        found.scenes("train")
    (tmp_path / "replica_val.txt").write_text("room_0\n")
    (tmp_path / "hm3d_val.txt").write_text("abcdefghijk\n")
    assert Replica().splits(tmp_path, ["room_0", "room_1"]) == {"room_0": "val"}
    write_hm3d(tmp_path)
    assert HM3D().splits(tmp_path, []) == {"abcdefghijk": "val"}


def test_splits_do_not_depend_on_other_buildings_or_on_the_root_folder(tmp_path: Path) -> None:
    """Half of HM3D's val is for test, by the name of each building; train is also recognised as the root folder."""
    names = [f"{letter * 11}" for letter in "abcdefgh"]
    for number, name in enumerate(names):
        inside = tmp_path / "val" / f"0080{number}-{name}"
        inside.mkdir(parents=True)
        (inside / f"{name}.semantic.txt").touch()
    whole = HM3D().splits(tmp_path, [])
    assert set(whole.values()) == {"val", "test"} and list(whole) == names
    (inside / f"{names[-1]}.semantic.txt").unlink()
    (tmp_path / "val" / f"00800-{names[0]}" / f"{names[0]}.semantic.txt").unlink()
    fewer = HM3D().splits(tmp_path / "val", [])
    assert fewer == {name: whole[name] for name in names[1:-1]}
    write_hm3d(tmp_path)
    assert HM3D().splits(tmp_path / "train", []) == {"abcdefghijk": "train"}
    rooms = ["apartment_0", "apartment_1", "apartment_2", "hotel_0", "room_0", "room_1", "room_2"]
    rooms += [f"office_{number}" for number in range(5)] + [f"frl_apartment_{number}" for number in range(6)]
    split_of = Replica().splits(tmp_path, rooms)
    assert {split_of[name] for name in rooms} == {"train", "val", "test"}
    assert len({split_of[name] for name in rooms if name.startswith("frl_apartment")}) == 1
    assert Replica().splits(tmp_path, rooms[3:]) == {name: split_of[name] for name in rooms[3:]}


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ASCII 1.1", "ASCII 9.9", "line 1: got 'ASCII 9.9', expected ASCII 1.0 or 1.1"),
        ("0 0 0 0 4 4 4 1", "0 0 0 0 4 5 4 1", "announces 5 records O, but it has 4"),
        ("0 0 0 0 4 4 4 1", "0 0 0 0 5 4 4 1", "announces 5 records E, but it has 4"),
        ("H 17", "X 17", "has no header"),
        ("C 0 0 raw#bed 0 bed 0 0 0 0 0", "C 0 0", "line 5: got 3 words, expected at least 6"),
        ("O 0 0 ", "O zero 0 ", "expected numbers"),
        ("O 0 0 ", "O -1 0 ", r"line 9: .*the id -1 is not in \[0, "),
        ("O 1 0 ", "O 0 0 ", "line 10: .*the id 0 occurs twice"),
        ("O 1 0 ", "O 99999999999 0 ", "line 10: .*the id 99999999999 is not in"),
        ("E 1 2 1000017", "E 1 2 1000024", "line 14: .*the id 1000024 occurs twice"),
    ],
)
def test_the_line_of_a_malformed_house_is_reported(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write_matterport(tmp_path)
    edit(path, old, new)
    with pytest.raises(UserError, match=message) as error:
        read(tmp_path, "matterport3d").scenes("train")
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("HM3D Semantic Annotations", "HM3D 2", "line 1: got 'HM3D 2'"),
        ('2,1A2B3C,"chair",0', "two,1A2B3C", "line 3: got 'two,1A2B3C'"),
        ("1A2B3C", "C7D5C5", "line 3: the colour C7D5C5 occurs twice"),
        ("2,1A2B3C", "0,1A2B3C", r"line 3: .*the id 0 is not in \[1, "),
        ("2,1A2B3C", "1,1A2B3C", "line 3: .*the id 1 occurs twice"),
        ("2,1A2B3C", "99999999999,1A2B3C", "line 3: .*the id 99999999999 is not in"),
        ("2,1A2B3C", "2,-1", "line 3: .*the colour '-1'"),
        ("2,1A2B3C", "2,1A2B3C4D", "line 3: .*the colour '1A2B3C4D'"),
        ('"chair",0', '"chair,0', "line 3: got .* expected an id"),
    ],
)
def test_the_line_of_a_malformed_annotation_of_hm3d_is_reported(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = write_hm3d(tmp_path)
    edit(path, old, new)
    with pytest.raises(UserError, match=message) as error:
        read(tmp_path, "hm3d").scenes("train")
    assert str(path) in str(error.value)


def rendered_colours(scene: Scene) -> list[tuple[int, ...]]:
    """Return the colours in views from random poses; there is no shading, since the lighting is uniform."""
    renderer, camera = renderer_of(scene), Camera.from_degrees(48, 48, 90.0, 1.25)
    poses = sample_poses(scene.free_space, 4, np.random.default_rng(5))
    images = [renderer.render(camera, camera.to_world(pose, scene.floor_height)) for pose in poses]
    rgb = np.concatenate([image.rgb[image.instance >= 0] for image in images])
    return [tuple(colour) for colour in np.unique(rgb, axis=0).tolist()]


def test_hm3d_renders_its_textures_and_never_the_ground_truth(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Without a usable colour mesh the building is grey: the colours of the semantic mesh are ground truth."""
    annotation = write_hm3d(tmp_path)
    colour_mesh = annotation.with_name("abcdefghijk.glb")

    def colours() -> list[tuple[int, ...]]:
        _building.cache_clear()
        return rendered_colours(read(tmp_path, "hm3d").load("abcdefghijk_0"))

    assert set(colours()) <= {tuple(colour) for colour in COLOURS.tolist()} and len(colours()) > 2
    valid = colour_mesh.read_bytes()
    mesh = trimesh.load_scene(io.BytesIO(valid), file_type="glb", process=False).dump()[0]
    moved, shorter, plain = mesh.copy(), mesh.copy(), mesh.copy()
    moved.vertices[:4] += 0.05
    shorter.update_faces(np.arange(len(mesh.faces)) > 0)
    plain.visual = trimesh.visual.ColorVisuals()
    cases = [(b"", "cannot be read as GLB"), (None, "is missing")]
    for other, message in (
        (moved, "triangles are not those"),
        (shorter, "triangles are not those"),
        (plain, "without"),
    ):
        cases.append((trimesh.Scene([other]).export(file_type="glb"), message))
    for content, message in cases:
        colour_mesh.unlink(missing_ok=True)
        if content is not None:
            colour_mesh.write_bytes(content)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            assert len({channel for colour in colours() for channel in colour}) == 1, message
        assert str(colour_mesh) in caplog.text and message in caplog.text and "is grey" in caplog.text


def test_malformed_files_of_replica(tmp_path: Path) -> None:
    path = write_replica(tmp_path)
    info = json.loads(path.read_text())
    first = info["objects"][0]
    broken = {**info, "objects": [{**first, "oriented_bbox": {}}]}
    deep = 50_000
    cases = [
        ("[" * deep + "]" * deep, "is nested too deeply"),
        (json.dumps({"objects": [{**first, "id": -1}]}), r"objects\[0\] is invalid .*the id -1"),
        (json.dumps({"objects": [{**first, "id": 1.5}]}), r"objects\[0\] is invalid"),
        (json.dumps({"objects": [{**first, "id": 2**31}]}), r"objects\[0\] is invalid"),
        (json.dumps({"objects": [first, first]}), r"objects\[1\] is invalid .*the id 0 occurs twice"),
        ("{", "is not valid JSON"),
        ("[]", "has no list 'objects'"),
        (json.dumps(broken), r"objects\[0\] is invalid"),
        (json.dumps({"objects": []}), "got no objects"),
    ]
    for text, message in cases:
        path.write_text(text)
        with pytest.raises(UserError, match=message) as error:
            read(tmp_path, "replica").scenes("train")
        assert str(path) in str(error.value)


XYZ = "property float x|property float y|property float z"


def ascii_ply(header: str, *rows: str) -> bytes:
    """Return an ASCII PLY file; `header` separates its lines by bars."""
    return "\n".join(["ply", "format ascii 1.0", *header.split("|"), "end_header", *rows, ""]).encode()


def triangle(header: str, row: str) -> bytes:
    """Return a PLY file of three vertices and one face."""
    return ascii_ply(f"element vertex 3|{XYZ}|element face 1|{header}", "0 0 0", "1 0 0", "0 1 0", row)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ascii_ply("element vertex two"), "line 3: got 'two' elements"),
        (ascii_ply(f"element vertex -1440|{XYZ}"), "line 3: got '-1440' elements"),
        (ascii_ply("comment " + "x" * 5000 + "|element face 1000000000"), "line 3: got more than 4096 bytes"),
        (b"nothing", "invalid header"),
        (ascii_ply("element vertex 0|property float x"), "has no y"),
        (ascii_ply(f"element vertex 1000000000000|{XYZ}"), "line 3: announces 1000000000000 elements"),
        (ascii_ply("element vertex 1|property list uchar float x", "1 0"), "expected numbers"),
        (triangle("property int vertex_indices", "0"), "expected lists of integers"),
        (triangle("property list uchar float vertex_indices", "3 0 1 2"), "expected lists of integers"),
        (
            triangle(
                "property list uchar int vertex_indices|property list uchar int segment_id", "3 0 1 2 1 0"
            ),
            "expected integers",
        ),
        (
            triangle("property list uchar int vertex_indices|property float segment_id", "3 0 1 2 0.5"),
            "expected integers",
        ),
    ],
)
def test_a_malformed_mesh_is_reported(tmp_path: Path, content: bytes, message: str) -> None:
    house = write_matterport(tmp_path)
    house.with_suffix(".ply").write_bytes(content)
    with pytest.raises(UserError, match=message) as error:
        read(tmp_path, "matterport3d").scenes("train")
    assert str(house.with_suffix(".ply")) in str(error.value)


def test_a_list_that_is_not_text_is_reported(tmp_path: Path) -> None:
    write_matterport(tmp_path)
    (tmp_path / "scenes_train.txt").write_text("17DRP5sb8fy", encoding="utf-16")
    with pytest.raises(UserError, match=r"scenes_train\.txt: cannot be read"):
        read(tmp_path, "matterport3d").scenes("train")


def test_a_truncated_mesh_and_invalid_indices_are_reported(tmp_path: Path) -> None:
    house = write_matterport(tmp_path)
    path = house.with_suffix(".ply")
    content = path.read_bytes()
    path.write_bytes(content[:-40])
    with pytest.raises(UserError, match="cannot be read as PLY"):
        read(tmp_path, "matterport3d").scenes("train")
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0]], np.float32)
    rgb = np.zeros((3, 3), np.uint8)
    ply(path, square, np.array([[0, 1, 7]]), rgb, {"segment_id": np.array([0])})
    with pytest.raises(UserError, match="faces refer to vertices 0 to 7, expected 0 to 2"):
        read(tmp_path, "matterport3d").scenes("train")
    ply(path, square, np.array([[0, 1, 2]]), rgb, {"segment_id": np.array([99])})
    with pytest.raises(UserError, match="none of 4 objects has a face"):
        read(tmp_path, "matterport3d").scenes("train")


def test_a_mesh_without_a_floor_is_reported(tmp_path: Path) -> None:
    house = write_matterport(tmp_path)
    wall = np.array([[0, 0, 0], [9, 0, 0], [9, 0, 3]], np.float32)
    rgb = np.zeros((3, 3), np.uint8)
    ply(house.with_suffix(".ply"), wall, np.array([[0, 1, 2]]), rgb, {"segment_id": np.array([0])})
    with pytest.raises(UserError, match=r"got at most 0\.0 m2"):
        read(tmp_path, "matterport3d").scenes("train")


@pytest.mark.parametrize("name", [*WRITERS, "scannet"])
def test_a_wrong_folder_is_reported(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError, match=r"data\.scenes\.folder: got .*/none"):
        source(tmp_path, f"data/scenes={name}", f"data.scenes.folder={tmp_path}/none")
    message = "pip install -e '\\.\\[scenezoo\\]'|found no" if name == "scannet" else "found no .* expected"
    with pytest.raises(UserError, match=message):
        read(tmp_path, name)


def test_colours_of_faces_keep_five_bits() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (200, 3)).astype(np.uint8)
    (material,), rows, uv = colour_texture(rgb)
    assert material.texture is not None and not rows.any()
    height, width = material.texture.shape[:2]
    texel = material.texture[((1 - uv[:, 0, 1]) * height).astype(int), (uv[:, 0, 0] * width).astype(int)]
    assert np.abs(texel.astype(int) - rgb).max() <= 8


def test_a_box_contains_points_and_annotation() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    corners = np.array([[x, y, z] for x in (-3, 3) for y in (-1, 1) for z in (0, 1)], float)
    box = upright_box(points, corners)
    cos, sin = np.cos(box.yaw), np.sin(box.yaw)
    for cloud in (points, corners):
        offset = cloud - np.array(box.centre)
        local = np.stack(
            [offset[:, 0] * cos + offset[:, 1] * sin, offset[:, 1] * cos - offset[:, 0] * sin, offset[:, 2]],
            1,
        )
        assert (np.abs(local) <= np.array(box.size) / 2 + 1e-5).all()


LARGE = """
import sys
from pathlib import Path
from tests.helpers.scene_sources import source
from imagination.scenes.renderer import renderer_of
folder = Path(sys.argv[1])
found = source(folder, "data/scenes=matterport3d", f"data.scenes.folder={folder}")
scene = found.load(found.scenes("train")[0])
renderer_of(scene)
print(len(scene.mesh.faces))
"""


@pytest.mark.slow
def test_five_million_triangles_take_less_than_8_gb(tmp_path: Path) -> None:
    house = write_matterport(tmp_path)
    side = 1582
    x, y = np.meshgrid(np.linspace(-3, 7, side), np.linspace(-5, 4, side))
    z = 0.6 + 0.002 * np.sin(40 * x) * np.sin(40 * y)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    first = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    quads = np.stack([first, first + 1, first + side + 1, first + side], axis=-1)
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    owner = np.where(np.arange(len(faces)) % 1000 == 0, 0, -1)
    rgb = np.full((len(vertices), 3), 150, np.uint8)
    ply(house.with_suffix(".ply"), vertices, faces, rgb, {"segment_id": owner})
    done = subprocess.run(
        [sys.executable, "-c", LARGE, str(tmp_path)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 4_999_000
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < 8e6
