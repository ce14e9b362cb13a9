"""Trials of the evaluation and their views: sparse viewpoints of a scene with random headings, kept in the cache."""

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from imagination.evaluation.viewpoints import sparse_viewpoints
from imagination.geometry.pose import Pose
from imagination.utils.progress import progress
from imagination.views.collector import Views, stack
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream
from imagination.views.scene_workers import ScenePool

KIND = "evaluation_views"
"""Kind of the cache entries that hold the views of a trial."""


class Trial(NamedTuple):
    """One viewpoint set of one scene.

    Attributes:
        scene: name of the scene.
        cell_width: spacing of the viewpoints, metres.
        number: index of the viewpoint set.
    """

    scene: str
    cell_width: float
    number: int


class ViewpointSampling(NamedTuple):
    """Random draw of the viewpoints of trials.

    Attributes:
        seed: seed of viewpoints and headings.
        orientations: random headings at each viewpoint.
    """

    seed: int
    orientations: int

    def key(self, observer: Observer, trial: Trial) -> dict[str, Any]:
        """Return the cache key of the views of a trial."""
        return {"views": observer.view_key(trial.scene), "trial": list(trial), "sampling": list(self)}


def trials_of(scenes: Sequence[str], cell_widths: Sequence[float], viewpoint_sets: int) -> list[Trial]:
    """Return all trials: every scene, cell width and viewpoint set."""
    places = product(scenes, map(float, cell_widths), range(viewpoint_sets))
    return [Trial(scene, width, number) for scene, width, number in places]


def render(pool: ScenePool, trials: Sequence[Trial], sampling: ViewpointSampling, silent: bool) -> None:
    """Render the views of all trials that are missing in the cache, those of each scene in its worker process.

    Args:
        pool: worker processes that render.
        trials: trials to render.
        sampling: draw of the viewpoints.
        silent: whether to show no progress bar.
    """
    missing: dict[str, list[Trial]] = {}
    for trial in trials:
        if pool.observer.cache.load(KIND, sampling.key(pool.observer, trial)) is None:
            missing.setdefault(trial.scene, []).append(trial)
    tasks = [pool.submit(_render_scene, scene, group, sampling) for scene, group in missing.items()]
    for task in tasks if silent or not tasks else progress(tasks, "views from sparse viewpoints (scenes)"):
        task.result()


def views_of(observer: Observer, trial: Trial, sampling: ViewpointSampling) -> Views:
    """Return the views of one trial, ordered by viewpoint, then by orientation.

    The dictionary holds the arrays of `stack` and snap_distance, the distance from each viewpoint to its free cell in
    metres.
    """
    return observer.cache.get_or_build(
        KIND, sampling.key(observer, trial), lambda: _render(observer, trial, sampling)
    )


def _render_scene(
    observer: Observer, scene: str, trials: Sequence[Trial], sampling: ViewpointSampling
) -> None:
    for trial in trials:
        views_of(observer, trial, sampling)


def _render(observer: Observer, trial: Trial, sampling: ViewpointSampling) -> Views:
    # cell widths in millimetres: seeds are integers
    rng = np.random.default_rng(
        [
            sampling.seed,
            Stream.VIEWPOINTS,
            crc32(trial.scene.encode()),
            round(trial.cell_width * 1000),
            trial.number,
        ]
    )
    viewpoints = sparse_viewpoints(observer.scene(trial.scene).free_space, trial.cell_width, rng)
    headings = rng.uniform(-np.pi, np.pi, (len(viewpoints.snapped), sampling.orientations))
    poses = [
        Pose(float(x), float(y), float(theta))
        for (x, y), turns in zip(viewpoints.snapped, headings, strict=True)
        for theta in turns
    ]
    x, y = observer.ground_truth(trial.scene).points[0].tolist()
    placeholder = Pose(x, y, 0.0)  # gives the arrays of an empty viewpoint set their shapes
    arrays = stack([observer.observe(trial.scene, pose, rng) for pose in poses or [placeholder]])
    views = {name: values[: len(poses)] for name, values in arrays.items()}
    return {**views, "snap_distance": viewpoints.distance}
