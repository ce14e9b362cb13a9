"""Compute what the reference holds, from today's code."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra.utils import instantiate

from imagination.config.compose import compose
from imagination.evaluation.trials import ViewpointSampling, trials_of, views_of
from imagination.scenes.scene import Scene
from imagination.utils.tabular import read_csv
from imagination.views.observer import Observer
from imagination.views.pose_samplers import sample_poses

FOLDER = Path(__file__).parent
SCENES = "train_0000", "train_0001", "val_0000", "test_0000"
EXPERIMENTS = "chair_unet", "bed_unet", "table_unet", "segmentation_hrnet"
OVERRIDES = "scale=test", "trainer.precision=32-true"
MAPS = "occupied", "label", "segmented", "truth"
POSES = 16
"""Number of sampled poses of each scene."""


def make_observer(cache: Path) -> Observer:
    """Return the observer of scale=test."""
    config = compose("train", ["+experiment=chair_unet", *OVERRIDES, "paths.run=.", f"paths.cache={cache}"])
    observer: Observer = instantiate(config.data.observer)
    return observer


def digest(*arrays: np.ndarray) -> str:
    """Return a hash of arrays; floats are rounded to 0.1 mm, since processors differ in the last digits."""
    result = hashlib.sha256()
    for array in arrays:
        exact = (
            array
            if array.dtype.kind in "biu"
            else np.round(np.asarray(array, np.float64) * 1e4).astype(np.int64)
        )
        result.update(repr(exact.shape).encode() + np.ascontiguousarray(exact).tobytes())
    return result.hexdigest()[:16]


def scene_hashes(scene: Scene) -> dict[str, str]:
    """Return hashes of a scene's geometry, objects and free space."""
    boxes = [(*obj.box.centre, *obj.box.size, obj.box.yaw) for obj in scene.objects]
    labels = " ".join(f"{obj.instance} {obj.label} {obj.category}" for obj in scene.objects)
    return {
        "vertices": digest(scene.mesh.vertices),
        "faces": digest(scene.mesh.faces, scene.mesh.face_instance, scene.mesh.face_material),
        "boxes": digest(np.array(boxes)),
        "labels": hashlib.sha256(labels.encode()).hexdigest()[:16],
        "free_space": digest(scene.free_space.mask),
    }


def pose_hashes(observer: Observer, name: str) -> dict[str, str]:
    """Return hashes of sampled poses and, for each cell width, of the viewpoints of Algorithm 1."""
    scene = observer.scene(name)
    sampled = sample_poses(scene.free_space, POSES, np.random.default_rng(0))
    hashes = {"sampled": digest(np.array([[pose.x, pose.y, pose.theta] for pose in sampled]))}
    for trial in trials_of([name], (3.0, 2.5), 1):
        views = views_of(observer, trial, ViewpointSampling(seed=0, orientations=2))
        hashes[f"viewpoints_{trial.cell_width:g}m"] = digest(views["pose"])
    return hashes


def integer_maps(observer: Observer) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the ground-truth maps of all scenes, such as ("test_0000/truth", M_gt)."""
    for name in SCENES:
        ground_truth = observer.ground_truth(name)
        for field in MAPS:
            yield f"{name}/{field}", getattr(ground_truth, field)


def table(path: Path) -> dict[str, dict[str, Any]]:
    """Return the IoU and pixel columns of mapping.csv and mapping_details.csv by approach, category and cell width.

    The two test scenes of scale=test are too few for intervals.
    """
    merged: dict[str, dict[str, Any]] = {}
    for file in (path, path.with_name("mapping_details.csv")):
        for row in read_csv(file):
            values = merged.setdefault(f"{row['approach']} {row['category']} {row['cell_width']}", {})
            values |= {
                name: float(value)
                for name, value in row.items()
                if value
                and (name.startswith("iou") or name in ("correct_pixels", "false_positives", "gt_pixels"))
            }
    return merged


def read_reference() -> dict[str, Any]:
    """Return the stored reference; its maps are in maps.npz."""
    content: dict[str, Any] = json.loads((FOLDER / "reference.json").read_text())
    return content


def check_table(path: Path, experiment: str) -> None:
    """Check that the IoU of a mapping.csv is within 0.005 of the reference, and pixel counts within 2 %."""
    found, expected = table(path), read_reference()["tables"][experiment]
    assert found.keys() == expected.keys()
    for row, values in expected.items():
        for column, value in values.items():
            tolerance = 0.005 if column.startswith("iou") else max(3.0, 0.02 * value)
            assert found[row][column] == pytest.approx(value, abs=tolerance), (row, column)
