"""Scanned buildings: what is read back of tiny ones, floors, splits, and what malformed files get."""

import json
import logging
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from imagination.errors import UserError
from imagination.scenes.scene import SceneSource
from tests.conftest import ROOT
from tests.scene_sources.buildings import (
    ply,
    tiny_building,
    write_hm3d,
    write_matterport,
    write_replica,
)
from tests.scene_sources.sources import source

from imagination_scans.building import coloured, upright_box  # isort: skip
from imagination_scans.matterport3d import SPLIT_LISTS  # isort: skip

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
    by_label = {thing.label: thing for thing in scene.objects}
    for thing in room.objects:
        box = by_label[thing.label].box
        assert by_label[thing.label].category == thing.category
        np.testing.assert_allclose(box.centre, thing.box.centre, atol=0.01)
        assert sorted(box.size[:2]) == pytest.approx(sorted(thing.box.size[:2]), abs=0.01)
        gap = np.linalg.norm(box.footprint()[:, None] - thing.box.footprint()[None], axis=2).min(axis=1)
        assert gap.max() < 0.02
    areas = []
    for mesh in (scene.mesh, room.mesh):
        corners = mesh.vertices[mesh.faces]
        areas.append(np.linalg.norm(np.cross(*np.diff(corners, axis=1).swapaxes(0, 1)), axis=1).sum() / 2)
    assert areas[0] == pytest.approx(areas[1], rel=1e-5)


def test_habitats_export_of_matterport_is_read_as_well(tmp_path: Path) -> None:
    write_matterport(tmp_path, habitat=True)
    scene = read(tmp_path, "matterport3d").load("17DRP5sb8fy_0")
    assert {thing.label for thing in scene.objects} == {"chair", "bed", "table", "lamp"}


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


def test_a_floor_larger_than_the_map_is_left_out_with_a_message(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_matterport(tmp_path)
    found = read(tmp_path, "matterport3d", "data.scenes.largest=4")
    with caplog.at_level(logging.WARNING), pytest.raises(UserError, match="gives a scene"):
        found.scenes("train")
    assert "17DRP5sb8fy_0 is left out: it measures" in caplog.text


def test_official_splits() -> None:
    lists = {path.stem: path.read_text().split() for path in SPLIT_LISTS.glob("*.txt")}
    every = [name for names in lists.values() for name in names]
    assert {stem: len(names) for stem, names in lists.items()} == {
        "matterport3d_train": 61,
        "matterport3d_val": 11,
        "matterport3d_test": 18,
    }
    assert len(set(every)) == 90


def test_lists_in_the_folder_come_first(tmp_path: Path) -> None:
    write_matterport(tmp_path)
    write_matterport(tmp_path, "mine")
    (tmp_path / "scenes_test.txt").write_text("mine\n")
    found = read(tmp_path, "matterport3d")
    assert found.scenes("test") == ["mine_0"]
    with pytest.raises(UserError, match="split train: none of the 2 buildings"):
        found.scenes("train")


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("ASCII 1.1", "ASCII 9.9", "line 1: got 'ASCII 9.9', expected ASCII 1.0 or 1.1"),
        ("0 0 0 0 0 4 4 1", "0 0 0 0 0 5 4 1", "announces 5 records O, but it has 4"),
        ("H 17", "X 17", "has no header"),
        ("C 0 0 raw#bed 0 bed 0 0 0 0 0", "C 0 0", "line 5: got 3 words, expected 6"),
        ("O 0 0 ", "O zero 0 ", "expected numbers"),
    ],
)
def test_a_malformed_house_is_told_with_its_line(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = write_matterport(tmp_path)
    edit(path, old, new)
    with pytest.raises(UserError, match=told) as error:
        read(tmp_path, "matterport3d").scenes("train")
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("HM3D Semantic Annotations", "HM3D 2", "line 1: got 'HM3D 2'"),
        ('2,1A2B3C,"chair",0', "two,1A2B3C", "line 3: got 'two,1A2B3C'"),
        ("1A2B3C", "C7D5C5", "line 3: the colour C7D5C5 occurs twice"),
    ],
)
def test_a_malformed_annotation_of_hm3d_is_told_with_its_line(
    tmp_path: Path, old: str, new: str, told: str
) -> None:
    edit(write_hm3d(tmp_path), old, new)
    with pytest.raises(UserError, match=told):
        read(tmp_path, "hm3d").scenes("train")


def test_malformed_files_of_replica(tmp_path: Path) -> None:
    path = write_replica(tmp_path)
    info = json.loads(path.read_text())
    broken = {**info, "objects": [{**info["objects"][0], "oriented_bbox": {}}]}
    cases = [
        ("{", "is no JSON"),
        ("[]", "has no list 'objects'"),
        (json.dumps(broken), r"objects\[0\] is broken"),
        (json.dumps({"objects": []}), "its semantics are empty"),
    ]
    for text, told in cases:
        path.write_text(text)
        with pytest.raises(UserError, match=told):
            read(tmp_path, "replica").scenes("train")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"ply\nformat ascii 1.0\nelement vertex two\nend_header\n", "header is broken"),
        (b"nothing", "header is broken"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "has no y"),
    ],
)
def test_a_malformed_mesh_is_told(tmp_path: Path, content: bytes, told: str) -> None:
    house = write_matterport(tmp_path)
    house.with_suffix(".ply").write_bytes(content)
    with pytest.raises(UserError, match=told) as error:
        read(tmp_path, "matterport3d").scenes("train")
    assert str(house.with_suffix(".ply")) in str(error.value)


def test_a_truncated_mesh_and_wrong_numbers_are_told(tmp_path: Path) -> None:
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
    with pytest.raises(UserError, match="none of its 4 objects has a face"):
        read(tmp_path, "matterport3d").scenes("train")


def test_a_mesh_without_a_floor_is_told(tmp_path: Path) -> None:
    house = write_matterport(tmp_path)
    wall = np.array([[0, 0, 0], [9, 0, 0], [9, 0, 3]], np.float32)
    rgb = np.zeros((3, 3), np.uint8)
    ply(house.with_suffix(".ply"), wall, np.array([[0, 1, 2]]), rgb, {"segment_id": np.array([0])})
    with pytest.raises(UserError, match="0.0 m2 of level floor"):
        read(tmp_path, "matterport3d").scenes("train")


@pytest.mark.parametrize("name", [*WRITERS, "scannet"])
def test_a_wrong_folder_is_told(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError, match="there is no folder"):
        source(tmp_path, f"data/scenes={name}", f"data.scenes.folder={tmp_path}/none")
    told = "pip install 'imagination\\[scenezoo\\]'|found no" if name == "scannet" else "found no .* expected"
    with pytest.raises(UserError, match=told):
        read(tmp_path, name)


def test_colours_of_faces_keep_five_bits() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (200, 3)).astype(np.uint8)
    (material,), rows, uv = coloured(rgb)
    assert material.texture is not None and not rows.any()
    height, width = material.texture.shape[:2]
    texel = material.texture[((1 - uv[:, 0, 1]) * height).astype(int), (uv[:, 0, 0] * width).astype(int)]
    assert np.abs(texel.astype(int) - rgb).max() <= 8


def test_a_box_holds_points_and_annotation() -> None:
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
from tests.scene_sources.sources import source
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
