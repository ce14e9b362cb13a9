"""The views that evaluation looks at: sparse viewpoints of a scene, two random headings each, kept in the cache."""

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
"""Name of these entries in the cache."""


class Trial(NamedTuple):
    """One viewpoint set of one scene.

    Attributes:
        scene: name of the scene.
        cell_width: spacing of the viewpoints, metres.
        number: of the set.
    """

    scene: str
    cell_width: float
    number: int


class ViewpointSampling(NamedTuple):
    """How the viewpoints of runs are drawn: the seed and how many random headings each gets."""

    seed: int
    orientations: int

    def key(self, observer: Observer, trial: Trial) -> dict[str, Any]:
        """What the views of a run depend on."""
        return {"views": observer.view_key(trial.scene), "run": list(trial), "looks": list(self)}


def trials_of(scenes: Sequence[str], cell_widths: Sequence[float], viewpoint_sets: int) -> list[Trial]:
    """All runs: every scene, cell width and viewpoint set."""
    places = product(scenes, map(float, cell_widths), range(viewpoint_sets))
    return [Trial(scene, width, number) for scene, width, number in places]


def render(pool: ScenePool, trials: Sequence[Trial], sampling: ViewpointSampling, silent: bool) -> None:
    """Put the views of all runs into the cache, those of each scene in its worker; what is there already stays.

    Args:
        pool: renders.
        runs: whose views are wanted.
        looks: how they are drawn.
        silent: show no progress, since something else does.
    """
    missing: dict[str, list[Trial]] = {}
    for trial in trials:
        if pool.observer.cache.load(KIND, sampling.key(pool.observer, trial)) is None:
            missing.setdefault(trial.scene, []).append(trial)
    tasks = [pool.submit(_render_scene, scene, home_runs, sampling) for scene, home_runs in missing.items()]
    for task in tasks if silent or not tasks else progress(tasks, "views from sparse viewpoints (scenes)"):
        task.result()


def views_of(observer: Observer, trial: Trial, sampling: ViewpointSampling) -> Views:
    """The views of one run, in viewpoint order, then orientation.

    Beside what `stack` gives: for each viewpoint snap_distance, how far it was moved to free space, metres.
    """
    return observer.cache.get_or_build(
        KIND, sampling.key(observer, trial), lambda: _look(observer, trial, sampling)
    )


def _render_scene(
    observer: Observer, scene: str, trials: Sequence[Trial], sampling: ViewpointSampling
) -> None:
    for trial in trials:
        views_of(observer, trial, sampling)


def _look(observer: Observer, trial: Trial, sampling: ViewpointSampling) -> Views:
    # widths in millimetres, since seeds are integers
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
    x, y = observer.truth(trial.scene).points[0].tolist()
    somewhere = Pose(x, y, 0.0)  # gives the arrays of an empty set their shapes
    arrays = stack([observer.observe(trial.scene, pose, rng) for pose in poses or [somewhere]])
    views = {name: values[: len(poses)] for name, values in arrays.items()}
    return {**views, "snap_distance": viewpoints.distance}
