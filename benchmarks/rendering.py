"""Views a second, beside bare ray casting of the same rays."""

from __future__ import annotations

from multiprocessing import get_context
from multiprocessing.synchronize import Barrier
from time import perf_counter

import numpy as np

from benchmarks.measure import Figure, medians
from benchmarks.subjects import camera, home, poses, with_triangles
from imagination.scenes import renderer as module
from imagination.scenes.renderer import Renderer

VIEWS = 16
"""Rendered in a round."""

SECONDS = 3.0

TRIANGLES = 50_000, 250_000, 1_000_000


def run(_: str) -> list[Figure]:
    """All figures."""
    # first, while this process is small
    together = {
        (triangles, size): [in_processes(count, triangles, size) for count in (1, 2)]
        for triangles in TRIANGLES
        for size in (128, 256)
    }
    figures = []
    for triangles in TRIANGLES:
        for size in (128, 256):
            render, trace = measured(triangles, size)
            asked = 200.0 if (triangles, size) == (250_000, 128) else None
            what = f"rendering {size}², RGB + depth + ids, {triangles // 1000} k triangles, 1 process"
            bare = "bare Embree on the same rays"
            figures.append(Figure(what, VIEWS / render, "views/s", VIEWS / trace, bare, asked))
            if asked:
                figures.append(Figure(f"{what}: share of tracing", trace / render, "of the time", target=0.6))
    for (triangles, size), (one, two) in together.items():
        what = f"rendering {size}², RGB + depth + ids, {triangles // 1000} k triangles, 2 processes"
        figures.append(Figure(what, two, "views/s", 2 * one, "twice 1 process", note="together"))
    return figures


def measured(triangles: int, size: int) -> tuple[float, float]:
    """Seconds to render, and only to trace, a round of views."""
    scene, lens = home(), camera(size)
    renderer = Renderer(with_triangles(scene.mesh, triangles), scene.lighting)
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


def in_processes(count: int, triangles: int, size: int) -> float:
    """Views a second of so many processes together."""
    context = get_context("spawn")
    barrier = context.Barrier(count)
    with context.Pool(count, initializer=_begin, initargs=(barrier,)) as pool:
        return float(np.sum(pool.map(_render, [(triangles, size)] * count, chunksize=1)))


_barrier: Barrier  # of a worker process


def _begin(barrier: Barrier) -> None:
    global _barrier
    _barrier = barrier


def _render(what: tuple[int, int]) -> float:
    triangles, size = what
    scene, lens = home(), camera(size)
    renderer = Renderer(with_triangles(scene.mesh, triangles), scene.lighting)
    places = [lens.to_world(pose, scene.floor_height) for pose in poses(scene, VIEWS)]
    renderer.render(lens, places[0])
    _barrier.wait()
    start, done = perf_counter(), 0
    while perf_counter() < start + SECONDS:
        renderer.render(lens, places[done % VIEWS])
        done += 1
    return done / (perf_counter() - start)
