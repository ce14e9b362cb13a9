"""Rendering speed, relative to ray casting of the same rays alone."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context

from imagination.scenes import renderer as module
from imagination.scenes.renderer import Renderer
from tests.benchmarks.measure import Figure, medians
from tests.benchmarks.subjects import camera, poses, procedural_scene, with_triangles

VIEWS = 16
"""Number of views in a round."""

SECONDS = 3.0

TRIANGLES, SIZES = (50_000, 250_000, 1_000_000), (128, 256)


def run(_: str) -> list[Figure]:
    """Return all figures."""
    parallel = in_processes()  # first, while the memory of this process is small
    figures = []
    for triangles in TRIANGLES:
        for size in SIZES:
            render, trace = measured(triangles, size)
            target = 200.0 if (triangles, size) == (250_000, 128) else None
            what = f"rendering {size}², RGB + depth + ids, {triangles // 1000} k triangles, 1 process"
            bare = "bare Embree on the same rays"
            figures.append(Figure(what, VIEWS / render, "views/s", VIEWS / trace, bare, target))
            if target:
                figures.append(
                    Figure(f"{what}: fraction of tracing", trace / render, "of the time", target=0.6)
                )
    return figures + parallel


def measured(triangles: int, size: int) -> tuple[float, float]:
    """Return the time to render a round of views and to trace its rays alone, seconds."""
    scene, lens = procedural_scene(), camera(size)
    renderer = renderer_with(triangles)
    cameras = [lens.to_world(pose, scene.floor_height) for pose in poses(scene, VIEWS)]
    rays = [
        module._rays(lens.width, lens.height, lens.focal_length, *lens.principal_point, camera_to_world)
        for camera_to_world in cameras
    ]

    def trace() -> None:
        for origins, directions in rays:
            renderer._scene.run(origins, directions, query="INTERSECT", output=True)

    times = medians(
        {"render": lambda: [renderer.render(lens, pose) for pose in cameras], "trace": trace}, SECONDS
    )
    return times["render"], times["trace"]


@lru_cache(1)
def renderer_with(triangles: int) -> Renderer:
    """Return the renderer of a scene with a number of triangles."""
    scene = procedural_scene()
    return Renderer(with_triangles(scene.mesh, triangles), scene.lighting)


def in_processes(rounds: int = 4) -> list[Figure]:
    """Measure two parallel processes, alternating with one; each renders some rounds, and the slower one counts."""
    figures = []
    workers = [ProcessPoolExecutor(1, get_context("spawn")) for _ in range(2)]

    def rendering(count: int, triangles: int, size: int) -> Callable[[], None]:
        def render() -> None:
            for task in [worker.submit(_render, triangles, size, rounds) for worker in workers[:count]]:
                task.result()

        return render

    for triangles in TRIANGLES:
        for size in SIZES:
            times = medians({str(count): rendering(count, triangles, size) for count in (1, 2)}, SECONDS)
            one, two = (count * rounds * VIEWS / times[str(count)] for count in (1, 2))
            what = f"rendering {size}², RGB + depth + ids, {triangles // 1000} k triangles, 2 processes"
            figures.append(Figure(what, two, "views/s", 2 * one, "twice 1 process"))
    for worker in workers:
        worker.shutdown()
    return figures


def _render(triangles: int, size: int, rounds: int) -> None:
    scene, lens, renderer = procedural_scene(), camera(size), renderer_with(triangles)
    cameras = [lens.to_world(pose, scene.floor_height) for pose in poses(scene, VIEWS)]
    for camera_to_world in rounds * cameras:
        renderer.render(lens, camera_to_world)
