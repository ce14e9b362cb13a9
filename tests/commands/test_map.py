"""`imagination.map` as a user runs it: the same map from every kind of recording, and its errors."""

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imagination.deployment.load import load
from imagination.mapping.map_io import load_layer, load_maps, load_objects
from imagination.mapping.semantic_map import Maps
from imagination.mapping.semantic_mapper import SemanticMapper
from tests.conftest import ROOT, Command
from tests.helpers.robot import RecordedFrame, corridor_path, drive, record_bag, record_tum, seconds
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import CAMERA

K = "recording.camera.values.colour={width:48,height:48,fx:24,fy:24,cx:23.5,cy:23.5}"


@pytest.fixture(scope="module")
def frames() -> list[RecordedFrame]:
    scene = tiny_room()
    return list(drive(scene, CAMERA, corridor_path(scene.free_space, 12)))


def direct(unit_file: Path, frames: list[RecordedFrame]) -> Maps:
    """Return the map of the scene itself, without a recording."""
    mapper = SemanticMapper(load(unit_file))
    for frame in frames:
        mapper.update(frame.rgb, frame.depth, frame.pose)
    return mapper.maps


def at(maps: Maps, threshold: float) -> Maps:
    return replace(maps, thresholds=(threshold,))


def same(one: Maps, other: Maps) -> None:
    assert (one.grid, one.categories, one.thresholds) == (other.grid, other.categories, other.thresholds)
    for name in ("written", "known"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in ("probabilities", "occupancy"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-5)


def test_a_tum_folder_and_a_bag_give_the_map_of_the_scene(
    command: Command, tmp_path: Path, unit_file: Path, frames: list[RecordedFrame]
) -> None:
    record_tum(tmp_path / "tum", frames, CAMERA)
    record_bag(tmp_path / "drive", frames, CAMERA)
    wanted = direct(unit_file, frames)
    assert wanted.known.sum() > 400 and wanted.probabilities.max() > 0.5
    for arguments in (["recording=tum", "recording.path=tum", K], ["recording=bag", "recording.path=drive"]):
        done = command("map", *arguments, f"unit={unit_file}", "viewer=preview", "viewer.format=gif")
        assert done.returncode == 0, done.stderr
        assert "12 frames mapped, 0 skipped" in done.stderr
        folder = (tmp_path / "outputs" / "map" / "latest").resolve()
        maps = load_maps(folder)
        same(maps, wanted)
        assert maps.frame == "map"
        assert (load_layer(folder / "map.yaml").layer == wanted.occupancy_layer()).all()
        assert (load_layer(folder / "chair.yaml").layer == wanted.category_layer("chair")).all()
        assert len(load_objects(folder / "objects.geojson")) == len(wanted.objects())
        assert (folder / "map.png").is_file() and (folder / "preview.gif").is_file()


@pytest.mark.slow
def test_a_drive_through_a_furnished_scene(command: Command, tmp_path: Path, unit_file: Path) -> None:
    """The same in a furnished scene, along its longest path."""
    from hydra.utils import instantiate

    from imagination.config.compose import compose

    scene = instantiate(compose("render", ["scale=test"]).data.scenes).load("test_0000")
    frames = list(drive(scene, CAMERA, corridor_path(scene.free_space, 60)))
    record_tum(tmp_path / "tum", frames, CAMERA)
    record_bag(tmp_path / "drive", frames, CAMERA, "sqlite3", odometry=True)
    wanted = direct(unit_file, frames)
    for arguments in (["recording=tum", "recording.path=tum", K], ["recording=bag", "recording.path=drive"]):
        done = command("map", *arguments, f"unit={unit_file}", timeout=600)
        assert done.returncode == 0, done.stderr
        same(load_maps(tmp_path / "outputs" / "map" / "latest"), wanted)


def test_the_map_before_a_corrupt_image_is_saved(
    command: Command, tmp_path: Path, unit_file: Path, frames: list[RecordedFrame]
) -> None:
    record_tum(tmp_path / "tum", frames, CAMERA)
    (tmp_path / "tum" / "rgb" / f"{seconds(frames[5].stamp)}.png").write_bytes(b"nothing")
    done = command("map", "recording.path=tum", K, f"unit={unit_file}", "extent=3.0", "threshold=0.3")
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "got 7 bytes" in done.stderr
    assert "5 frames mapped" in done.stderr
    assert "(extent, centre)" in done.stderr
    maps = load_maps(tmp_path / "outputs" / "map" / "latest")
    assert maps.grid.columns == 25 and maps.known.sum() > 50
    assert maps.thresholds == (0.3,)
    found = load_objects(tmp_path / "outputs" / "map" / "latest" / "objects.geojson")
    assert sum(obj.area for obj in found) > sum(obj.area for obj in at(maps, 0.55).objects())


@pytest.mark.slow
def test_the_map_has_the_frame_of_the_recording_and_survives_a_viewer_that_breaks(
    command: Command, tmp_path: Path, unit_file: Path, frames: list[RecordedFrame]
) -> None:
    record_bag(tmp_path / "drive", frames, CAMERA, odometry=True)
    arguments = ["recording=bag", "recording.path=drive", f"unit={unit_file}"]
    done = command("map", *arguments, "viewer._target_=tests.helpers.toy_units.Failing")
    assert done.returncode == 1 and "RuntimeError: the viewer is broken" in done.stderr
    maps = load_maps(tmp_path / "outputs" / "map" / "latest")
    assert maps.frame == "odom" and maps.known.sum() > 50
    done = command("map", *arguments, "frame=earth", "viewer=preview", "viewer.format=gif")
    folder = tmp_path / "outputs" / "map" / "latest"
    assert done.returncode == 0 and (folder / "preview.gif").is_file()
    assert load_maps(folder).frame == "earth"


def test_the_viewer_is_closed_if_the_map_cannot_be_saved(
    command: Command, tmp_path: Path, unit_file: Path, frames: list[RecordedFrame]
) -> None:
    record_tum(tmp_path / "tum", frames, CAMERA)
    arguments = [
        "recording.path=tum",
        K,
        f"unit={unit_file}",
        "viewer._target_=tests.helpers.toy_units.Blocking",
    ]
    done = command("map", *arguments)
    assert done.returncode == 2 and "could not write" in done.stderr and "Traceback" not in done.stderr
    assert len(list((tmp_path / "outputs" / "map").glob("*/closed"))) == 1


def test_a_recording_without_mapped_frames_is_an_error(
    command_in_process: Command, tmp_path: Path, unit_file: Path, frames: list[RecordedFrame]
) -> None:
    record_tum(tmp_path / "tum", frames, CAMERA)
    done = command_in_process("map", "recording.path=tum", K, f"unit={unit_file}", "floor_height=-3")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "recording: " in done.stderr and "0 frames mapped, 12 skipped" in done.stderr
    assert re.search(r"mount_height: .*4\.25 m.* 1\.25", " ".join(done.stderr.split()))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["unit=a.onnx"], "recording.path: got none"),
        (["recording.path=x"], "unit: got none"),
        (["recording.path=x", "unit=a.onnx"], "unit: got a.onnx"),
        (["recording=rosbag", "recording.path=x"], "bag, folder, scannet, tum"),
        (["recording.path=x", "unit=a.onnx,b.onnx", "-m"], "-m: imagination.map "),
    ],
)
def test_user_errors_get_one_message(command_in_process: Command, arguments: list[str], message: str) -> None:
    done = command_in_process("map", *arguments)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert message in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("number", "code"),
    [pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow), (signal.SIGTERM, 143)],
)
def test_a_signal_saves_the_map(
    tmp_path: Path, unit_file: Path, frames: list[RecordedFrame], number: int, code: int
) -> None:
    many = [
        frame._replace(stamp=frames[0].stamp + number * 10**8) for number, frame in enumerate(frames * 150)
    ]
    record_bag(tmp_path / "drive", many, CAMERA)
    arguments = ["recording=bag", "recording.path=drive", f"unit={unit_file}"]
    arguments.append("viewer._target_=tests.helpers.toy_units.Marker")
    with open(tmp_path / "stderr", "w") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "imagination.map", *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stderr=stderr,
        )
        try:
            while not list((tmp_path / "outputs").glob("map/*/shown")):
                assert process.poll() is None, (tmp_path / "stderr").read_text()
                time.sleep(0.02)
            process.send_signal(number)
            time.sleep(0.05)
            process.send_signal(number)  # while it saves
            assert process.wait(120) == code
        finally:
            process.kill()
    text = (tmp_path / "stderr").read_text()
    assert "Traceback" not in text and text.count("Interrupted") == 1
    assert "imagination.map recording=bag" in text
    assert load_maps(tmp_path / "outputs" / "map" / "latest").known.any()
