"""One frame end to end, and ten thousand of them: `pytest -m slow -s tests/deployment/test_frame_latency.py`."""

import resource
import time
from pathlib import Path

import numpy as np
import pytest

from imagination.checkpoints import Checkpoint
from imagination.deployment.export import Sample, export
from imagination.deployment.load import load
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import project_depth
from imagination.mapping.module import Observation
from imagination.mapping.semantic import SemanticMapper
from imagination.scenes.renderer import Renderer
from imagination.viewers.preview import Preview
from tests.deployment.checkpoints import make_checkpoint
from tests.mapping.test_semantic import frames
from tests.modules import Toy
from tests.rooms import tiny_room

CATEGORIES = ("chair", "bed", "table")


class Stopwatch:
    """A module that notes how long it was asked."""

    def __init__(self, path: Path) -> None:
        self.module = load(path)
        self.description = self.module.description
        self.seconds: list[float] = []

    def __call__(self, observation: Observation) -> np.ndarray:
        start = time.perf_counter()
        answer = self.module(observation)
        self.seconds.append(time.perf_counter() - start)
        return answer


@pytest.mark.slow
def test_one_frame_at_desk_scale_takes_fifty_milliseconds(tmp_path: Path) -> None:
    """Three units of width 16 (the desk's), each with an encoder of its own, side by side in one ONNX file."""
    choices = ("scale=desk", "scale.precision=32-true")
    checkpoints = [
        Checkpoint.read(make_checkpoint(tmp_path / f"{name}.ckpt", *choices, f"unit_categories=[{name}]"))
        for name in CATEGORIES
    ]
    camera, ego, scene = Camera.from_degrees(128, 128, 90.0, 1.25), EgoGrid.of_extent(5.22, 0.06), tiny_room()
    renderer, rng = Renderer(scene.mesh, scene.lighting), np.random.default_rng(0)
    poses = [Pose(*rng.uniform(-0.8, 0.8, 2).tolist(), rng.uniform(-3, 3)) for _ in range(20)]
    images = [renderer.render(camera, camera.to_world(pose)) for pose in poses]
    view = project_depth(images[0].depth, camera, ego, Toy().description.obstacles)
    first = Observation(images[0].rgb, images[0].depth, view.occupied, view.seen, 1.25)
    export(
        checkpoints,
        tmp_path / "all.onnx",
        "onnx",
        "float32",
        [Sample(first, np.zeros((3, 87, 87), np.bool_))],
    )
    module = Stopwatch(tmp_path / "all.onnx")
    mapper = SemanticMapper(module)
    whole = []
    for number in range(220):
        image, pose = images[number % 20], poses[number % 20]
        start = time.perf_counter()
        mapper.update(image.rgb, image.depth, pose)
        whole.append(time.perf_counter() - start)
    milliseconds, network = 1e3 * np.array(whole[20:]), 1e3 * np.array(module.seconds[20:])
    p50, p95 = np.percentile(milliseconds, [50, 95])
    rest = np.median(milliseconds - network)
    print(
        f"\none frame, three units of width 16: p50 {p50:.1f} ms, p95 {p95:.1f} ms; without the network {rest:.2f} ms"
    )
    assert p50 < 50
    assert p95 <= 1.6 * p50
    assert rest < 6


@pytest.mark.slow
def test_memory_does_not_grow_over_ten_thousand_frames(tmp_path: Path) -> None:
    mapper, viewer = SemanticMapper(Toy(*CATEGORIES)), Preview("gif", most=20)
    viewer.open(tmp_path, mapper)
    seen = frames()

    def drive(count: int) -> int:
        """Kilobytes at most in use so far, after so many frames."""
        for number in range(count):
            viewer.show(number, mapper.update(*seen[number % len(seen)]))
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before, after = drive(1000), drive(9000)
    print(f"\nafter 1,000 frames {before / 1024:.0f} MB, after 10,000 {after / 1024:.0f} MB")
    assert after - before < 8 * 1024
