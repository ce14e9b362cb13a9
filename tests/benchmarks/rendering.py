"""Views a second, beside bare ray casting of the same rays."""

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
"""Rendered in a round."""

SECONDS = 3.0

TRIANGLES, SIZES = (50_000, 250_000, 1_000_000), (128, 256)


def run(_: str) -> list[Figure]:
    """All figures."""
    together = in_processes()  # first, while this process is small
    figures = []
    for triangles in TRIANGLES:
        for size in SIZES:
            render, trace = measured(triangles, size)
            asked = 200.0 if (triangles, size) == (250_000, 128) else None
            what = f"rendering {size}², RGB + depth + ids, {triangles // 1000} k triangles, 1 process"
            bare = "bare Embree on the same rays"
            figures.append(Figure(what, VIEWS / render, "views/s", VIEWS / trace, bare, asked))
            if asked:
                figures.append(Figure(f"{what}: share of tracing", trace / render, "of the time", target=0.6))
    return figures + together


def measured(triangles: int, size: int) -> tuple[float, float]:
    """Seconds to render, and only to trace, a round of views."""
    scene, lens = procedural_scene(), camera(size)
    renderer = renderer_with(triangles)
    places = [lens.to_world(pose, scene.floor_height) for pose in poses(scene, VIEWS)]
    rays = [
        module._rays(lens.width, lens.height, lens.focal_length, *lens.principal_point, place)
        for place in places
    ]

    def trace() -> None:
        for origins, directions in rays:
            renderer._scene.run(origins, directions, query="INTERSECT", output=True)

    times = medians(
        {"render": lambda: [renderer.render(lens, place) for place in places], "trace": trace}, SECONDS
    )
    return times["render"], times["trace"]


@lru_cache(1)
def renderer_with(triangles: int) -> Renderer:
    """Of a scene with so many triangles."""
    scene = procedural_scene()
    return Renderer(with_triangles(scene.mesh, triangles), scene.lighting)


def in_processes(epochs: int = 4) -> list[Figure]:
    """Two processes, in turns with one of them: each renders so many epochs, and the slower one counts."""
    figures = []
    workers = [ProcessPoolExecutor(1, get_context("spawn")) for _ in range(2)]

    def rendering(count: int, triangles: int, size: int) -> Callable[[], None]:
        def render() -> None:
            for task in [worker.submit(_render, triangles, size, epochs) for worker in workers[:count]]:
                task.result()

        return render

    for triangles in TRIANGLES:
        for size in SIZES:
            times = medians({str(count): rendering(count, triangles, size) for count in (1, 2)}, SECONDS)
            one, two = (count * epochs * VIEWS / times[str(count)] for count in (1, 2))
            what = f"rendering {size}², RGB + depth + ids, {triangles // 1000} k triangles, 2 processes"
            figures.append(Figure(what, two, "views/s", 2 * one, "twice 1 process"))
    for worker in workers:
        worker.shutdown()
    return figures


def _render(triangles: int, size: int, epochs: int) -> None:
    scene, lens, renderer = procedural_scene(), camera(size), renderer_with(triangles)
    places = [lens.to_world(pose, scene.floor_height) for pose in poses(scene, VIEWS)]
    for place in epochs * places:
        renderer.render(lens, place)
