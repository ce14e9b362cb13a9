"""Command that writes the ground truth of a scene as arrays and images."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from imagination.ground_truth.scene_maps import GroundTruth
from tests.conftest import Command
from tests.helpers.scanned_buildings import write_matterport


def test_arrays_and_images_of_every_stage_are_written(command: Command, tmp_path: Path) -> None:
    result = command("render", "scale=test", "split=test", "poses=12")
    assert result.returncode == 0, result.stderr
    folder = tmp_path / "outputs" / "render" / "test_0000"
    assert {path.name for path in folder.iterdir()} == {
        *("truth.npz", "views.npz", "render.log", "scene.png", "views.png", "labels.png"),
        *("chair.png", "bed.png", "table.png"),
    }
    arrays = dict(np.load(folder / "truth.npz"))
    assert arrays.pop("categories").tolist() == ["chair", "bed", "table"]
    gt = GroundTruth.from_arrays(arrays)
    np.testing.assert_array_equal(gt.truth, gt.occupied & gt.label & gt.segmented)
    assert gt.grid.shape == (201, 201) and gt.truth.any()
    with np.load(folder / "views.npz") as views:
        assert views["rgb"].shape == (3, 48, 48, 3) and views["label"].shape == (3, 31, 31)
        np.testing.assert_array_equal(views["label"], views["objects"] & views["imaginable"])
    for path in folder.glob("*.png"):
        image = cv2.imread(str(path))
        assert image is not None and image.std() > 10
    assert "objects" in result.stderr and "outputs/render/test_0000/" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["scene=attic"], "scene: got 'attic'"),
        (["split=exam"], "split: got 'exam'"),
        (["world.extent=4"], "ground_truth.extent"),
        (["poses=0"], "poses: got 0"),
    ],
)
def test_invalid_values_are_refused(
    command_in_process: Command, tmp_path: Path, arguments: list[str], message: str
) -> None:
    result = command_in_process("render", "scale=test", *arguments)
    assert result.returncode == 2 and message in result.stderr and "Traceback" not in result.stderr
    assert not list(tmp_path.rglob("*.npz"))


@pytest.mark.slow
def test_another_scene_source_is_drawn(command: Command, tmp_path: Path) -> None:
    write_matterport(tmp_path / "scans")
    scans = "scale=test", "data/scenes=matterport3d"
    result = command("render", *scans, "data.scenes.folder=scans", "poses=6")
    assert result.returncode == 0, result.stderr
    folder = tmp_path / "outputs" / "render" / "17DRP5sb8fy_0"
    assert (folder / "scene.png").is_file() and "chair: 1 objects" in result.stderr
    with np.load(folder / "truth.npz") as arrays:
        assert arrays["truth"].any()
    result = command("render", *scans)
    assert result.returncode == 2 and "Traceback" not in result.stderr
    assert "data.scenes.folder: got " in result.stderr
