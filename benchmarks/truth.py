"""Ground truth of one home: made, and read from the cache."""

from __future__ import annotations

from functools import partial
from statistics import median
from time import perf_counter

import numpy as np

from benchmarks.measure import Figure, medians
from benchmarks.subjects import floor_area, home_of, observer
from imagination.ground_truth.maps import _looks, build, look_points
from imagination.scenes import renderer as module
from imagination.scenes.renderer import Renderer

TIMES = 3
"""That the ground truth is made, for a median."""


def run(folder: str) -> list[Figure]:
    """All figures."""
    figures = []
    scene = home_of(100.0)
    area = f"{floor_area(scene):.0f} m² home"
    for scale, target in (("desk", 6.0), ("paper", 60.0)):
        watcher = observer(folder, f"scale={scale}")
        caster = Renderer(scene.mesh, scene.lighting)
        spec = watcher.truth_spec
        made = []
        for _ in range(TIMES):
            start = perf_counter()
            truth = build(scene, caster, spec, watcher.categories)
            made.append(perf_counter() - start)
        lens = spec.camera
        places = list(_looks(look_points(scene.free_space, spec.spacing), lens))
        some = places[:: max(1, len(places) // 40)]
        rays = [
            module._rays(
                lens.width, lens.height, lens.focal_length, *lens.principal_point, lens.to_world(pose, 0.0)
            )
            for pose in some
        ]
        trace = medians({"all": partial(_trace, caster, rays)}, 1.0, 3)["all"]
        figures.append(
            Figure(
                f"ground truth of a {area}, {scale} scale, 1 process",
                median(made),
                "s",
                trace * len(places) / len(some),
                f"bare Embree on its {len(places)} looks",
                target,
                at_most=True,
                note=f"made {TIMES} times",
            )
        )
        key = watcher.truth_key(scene.name)
        watcher.cache.store("ground_truth", key, truth.to_arrays())
        copy = [np.copy(array) for array in truth.to_arrays().values()]
        times = medians(
            {
                "load": lambda: watcher.cache.load("ground_truth", key),  # noqa: B023
                "copy": lambda: [array.copy() for array in copy],  # noqa: B023
            },
            1.0,
        )
        what = f"the same from the cache, {scale} scale"
        figures.append(
            Figure(what, times["load"], "s", times["copy"], "copying the arrays", 0.2, at_most=True)
        )
    return figures


def _trace(caster: Renderer, rays: list[tuple[np.ndarray, np.ndarray]]) -> None:
    for origins, directions in rays:
        caster._scene.run(origins, directions, query="INTERSECT", output=True)
