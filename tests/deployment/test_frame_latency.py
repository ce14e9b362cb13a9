"""Latency of a frame and memory of 10,000 frames: `pytest -m slow -s tests/deployment/test_frame_latency.py`."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imagination.deployment.export import Sample, export
from imagination.deployment.load import load
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import project_depth
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.mapping.predictor import Observation
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.runs.checkpoint import Checkpoint
from imagination.scenes.renderer import Renderer
from imagination.viewers.video import Preview
from tests.helpers.checkpoints import make_checkpoint
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import Toy
from tests.mapping.test_semantic_mapper import frames

CATEGORIES = ("chair", "bed", "table")

TRAINING_CAMERA = Camera.from_degrees(128, 128, 90.0, 1.25)
"""Camera of the units (scale=small)."""

SENSOR = Intrinsics(640, 480, 390.0, 390.0, 319.5, 239.5)
DEPTH_TO_COLOUR = np.eye(4)
DEPTH_TO_COLOUR[0, 3] = 0.015

ROBOTS = {
    "the units' camera": RgbdCamera.of(TRAINING_CAMERA),
    "a tilted camera of 640 x 480": RgbdCamera(SENSOR, pitch=0.1),
    "a tilted camera of 640 x 480 with a separate depth camera": RgbdCamera(
        SENSOR, replace(SENSOR, distortion=(0.1, -0.2, 0.001, 0.001, 0.05)), DEPTH_TO_COLOUR, pitch=0.1
    ),
}
"""Cameras by printed name; the third renders both images from one position, which costs as much."""


class Stopwatch:
    """Measures the duration of a function.

    Attributes:
        seconds: duration of each call.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.seconds: list[float] = []

    def __call__(self, *values: Any) -> Any:
        start = time.perf_counter()
        result = self.function(*values)
        self.seconds.append(time.perf_counter() - start)
        return result


class Timed:
    """Predictor that measures the duration of predictions."""

    def __init__(self, path: Path) -> None:
        self.predict = Stopwatch(load(path))
        self.spec = self.predict.function.spec

    def __call__(self, observation: Observation) -> np.ndarray:
        return self.predict(observation)


@pytest.fixture(scope="module", params=["false", "true"], ids=["plain", "tta_hflip"])
def unit(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """ONNX file of three units of width 16 (scale=small), each with a separate encoder."""
    folder = tmp_path_factory.mktemp("units")
    choices = ("scale=small", "trainer.precision=32-true", f"model.tta_hflip={request.param}")
    checkpoints = [
        Checkpoint.read(make_checkpoint(folder / f"{name}.ckpt", *choices, f"unit_categories=[{name}]"))
        for name in CATEGORIES
    ]
    rgb, depth = np.zeros((128, 128, 3), np.uint8), np.full((128, 128), 2.0, np.float32)
    view = project_depth(depth, TRAINING_CAMERA, EgoGrid.of_extent(5.22, 0.06), Toy().spec.obstacles)
    first = Observation(rgb, depth, view.occupied, view.seen, TRAINING_CAMERA.mount_height)
    sample = Sample(first, np.zeros((3, 87, 87), np.bool_))
    file = folder / ("tta_hflip.onnx" if request.param == "true" else "plain.onnx")
    export(checkpoints, file, "onnx", "float32", [sample])
    return file


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*the robot's:UserWarning")
@pytest.mark.parametrize("robot", ROBOTS, ids=ROBOTS)
def test_one_frame_at_small_scale_takes_fifty_milliseconds(
    unit: Path, robot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera, scene = ROBOTS[robot], tiny_room()
    renderer, rng = Renderer(scene.mesh, scene.lighting), np.random.default_rng(0)
    poses = [Pose(*rng.uniform(-0.8, 0.8, 2).tolist(), rng.uniform(-3, 3)) for _ in range(20)]
    k = camera.colour
    ideal = Camera(k.width, k.height, k.fields_of_view[0], camera.mount_height, camera.pitch, camera.roll)
    images = [renderer.render(ideal, ideal.to_world(pose)) for pose in poses]
    module = Timed(unit)
    mapper = SemanticMapper(module, camera)
    mapper.update(images[0].rgb, images[0].depth, poses[0])  # makes the map
    projection, update = Stopwatch(project_depth), Stopwatch(mapper.update)
    monkeypatch.setattr("imagination.mapping.semantic_mapper.project_depth", projection)
    monkeypatch.setattr(mapper._mapper, "register", registration := Stopwatch(mapper._mapper.register))
    module.predict.seconds.clear()
    for number in range(220):
        image, pose = images[number % 20], poses[number % 20]
        update(image.rgb, image.depth, pose)
    watches = update, module.predict, projection, registration
    whole, network, projected, registered = (1e3 * np.array(watch.seconds[20:]) for watch in watches)
    p50, p95 = np.percentile(whole, [50, 95])
    both = np.median(projected + registered)
    print(
        f"\none frame of {robot}, three units of width 16, {unit.stem}: p50 {p50:.1f} ms, p95 {p95:.1f} ms; "
        f"projection and registration {both:.2f} ms; all without the network {np.median(whole - network):.2f} ms"
    )
    assert p50 < 50
    assert p95 <= 1.6 * p50
    assert both < 6


@pytest.mark.slow
def test_memory_does_not_grow_over_ten_thousand_frames(tmp_path: Path, unit: Path) -> None:
    mapper, viewer = SemanticMapper(load(unit)), Preview("gif", max_frames=20)
    viewer.open(tmp_path, mapper)
    seen = frames(TRAINING_CAMERA)

    def drive(count: int) -> int:
        """Resident memory after some frames, kilobytes; the peak may be that of other tests."""
        for number in range(count):
            viewer.show(number, mapper.update(*seen[number % len(seen)]))
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmRSS:")[2].split()[0])

    before, after = drive(1000), drive(9000)
    print(f"\nafter 1,000 frames {before / 1024:.0f} MB, after 10,000 {after / 1024:.0f} MB")
    assert after - before < 8 * 1024
