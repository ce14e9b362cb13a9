"""Ground truth of one scene: made, and read from the cache."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from imagination.ground_truth.scene_maps import GroundTruthSpec, _panorama_poses, build, panorama_points
from imagination.scenes import renderer as module
from imagination.scenes.renderer import Renderer
from imagination.scenes.scene import Scene
from imagination.views.observer import Observer
from tests.benchmarks.measure import Figure, medians
from tests.benchmarks.subjects import floor_area, home_of, observer

SOME = 40
"""Looks that are traced for the limit, about."""


def run(folder: str) -> list[Figure]:
    """All figures."""
    scene = home_of(100.0)
    figures = []
    for scale, target in (("desk", 6.0), ("paper", 60.0)):
        watcher = observer(folder, f"scale={scale}")
        figures += [making(scene, watcher, scale, target), loading(scene, watcher, scale)]
    return figures


def making(scene: Scene, watcher: Observer, scale: str, target: float) -> Figure:
    """Truth from a scene that is loaded."""
    caster, spec = Renderer(scene.mesh, scene.lighting), watcher.ground_truth_spec
    trace, share, count = sampling(scene, caster, spec)
    make = partial(build, scene, caster, spec, watcher.categories)
    times = medians({"make": make, "trace": trace}, least=3)
    return Figure(
        f"ground truth of a {floor_area(scene):.0f} m² scene, {scale} scale, 1 process",
        times["make"],
        "s",
        times["trace"] / share,
        f"bare Embree on its {count} looks",
        target,
        at_most=True,
        note=f"the limit from {share:.0%} of the looks",
    )


def loading(scene: Scene, watcher: Observer, scale: str) -> Figure:
    """The same from the cache."""
    arrays, key = watcher.ground_truth(scene.name).to_arrays(), watcher.ground_truth_key(scene.name)
    times = medians(
        {
            "load": lambda: watcher.cache.load("ground_truth", key),
            "copy": lambda: [array.copy() for array in arrays.values()],
        },
        1.0,
    )
    what = f"the same from the cache, {scale} scale"
    return Figure(what, times["load"], "s", times["copy"], "copying the arrays", 0.2, at_most=True)


def sampling(scene: Scene, caster: Renderer, spec: GroundTruthSpec) -> tuple[Callable[[], None], float, int]:
    """Traces some of the looks of a scene's truth with bare Embree; their share of all, and how many all are."""
    lens = spec.camera
    places = list(_panorama_poses(panorama_points(scene.free_space, spec.spacing), lens))
    some = places[:: max(1, len(places) // SOME)]
    rays = [
        module._rays(
            lens.width, lens.height, lens.focal_length, *lens.principal_point, lens.to_world(pose, 0.0)
        )
        for pose in some
    ]

    def trace() -> None:
        for origins, directions in rays:
            caster._scene.run(origins, directions, query="INTERSECT", output=True)

    return trace, len(some) / len(places), len(places)


def tracing(watcher: Observer, scene: str) -> float:
    """Seconds that bare Embree takes for all looks of a scene's truth; runs in a worker process."""
    scene = watcher.scene(scene)
    trace, share, _ = sampling(scene, Renderer(scene.mesh, scene.lighting), watcher.ground_truth_spec)
    return medians({"trace": trace}, 0.5, 3)["trace"] / share
