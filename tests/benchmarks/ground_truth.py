"""Ground truth of one scene: computation, and reading from the cache."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from imagination.ground_truth.scene_maps import GroundTruthSpec, _panorama_poses, build, panorama_points
from imagination.scenes import renderer as module
from imagination.scenes.renderer import Renderer
from imagination.scenes.scene import Scene
from imagination.views.observer import Observer
from tests.benchmarks.measure import Figure, medians
from tests.benchmarks.subjects import floor_area, observer, scene_of_area

MAX_TRACED = 40
"""Approximate number of views that are traced for the limit."""


def run(folder: str) -> list[Figure]:
    """Return all figures."""
    scene = scene_of_area(100.0)
    figures = []
    for scale, target in (("small", 6.0), ("paper", 60.0)):
        views = observer(folder, f"scale={scale}")
        figures += [computation(scene, views, scale, target), loading(scene, views, scale)]
    return figures


def computation(scene: Scene, views: Observer, scale: str, target: float) -> Figure:
    """Measure the computation of the ground truth of a loaded scene."""
    caster, spec = Renderer(scene.mesh, scene.lighting), views.ground_truth_spec
    trace, fraction, count = sampling(scene, caster, spec)
    compute = partial(build, scene, caster, spec, views.categories)
    times = medians({"compute": compute, "trace": trace}, min_calls=3)
    return Figure(
        f"ground truth of a {floor_area(scene):.0f} m² scene, {scale} scale, 1 process",
        times["compute"],
        "s",
        times["trace"] / fraction,
        f"bare Embree on its {count} views",
        target,
        at_most=True,
        note=f"limit measured on {fraction:.0%} of the views",
    )


def loading(scene: Scene, views: Observer, scale: str) -> Figure:
    """Measure reading of the ground truth from the cache."""
    arrays, key = views.ground_truth(scene.name).to_arrays(), views.ground_truth_key(scene.name)
    times = medians(
        {
            "load": lambda: views.cache.load("ground_truth", key),
            "copy": lambda: [array.copy() for array in arrays.values()],
        },
        1.0,
    )
    what = f"the same from the cache, {scale} scale"
    return Figure(what, times["load"], "s", times["copy"], "copying the arrays", 0.2, at_most=True)


def sampling(scene: Scene, caster: Renderer, spec: GroundTruthSpec) -> tuple[Callable[[], None], float, int]:
    """Return a function that traces some of the views of the ground truth, their fraction, and the number of views."""
    lens = spec.camera
    poses = list(_panorama_poses(panorama_points(scene.free_space, spec.spacing), lens))
    traced = poses[:: max(1, len(poses) // MAX_TRACED)]
    rays = [
        module._rays(
            lens.width, lens.height, lens.focal_length, *lens.principal_point, lens.to_world(pose, 0.0)
        )
        for pose in traced
    ]

    def trace() -> None:
        for origins, directions in rays:
            caster._scene.run(origins, directions, query="INTERSECT", output=True)

    return trace, len(traced) / len(poses), len(poses)


def tracing(views: Observer, name: str) -> float:
    """Return the time of Embree for all views of a scene's ground truth, seconds; runs in a worker process."""
    scene = views.scene(name)
    trace, fraction, _ = sampling(scene, Renderer(scene.mesh, scene.lighting), views.ground_truth_spec)
    return medians({"trace": trace}, 0.5, 3)["trace"] / fraction
