"""The views that evaluation looks at: sparse viewpoints of a home, two random headings each, kept in the cache."""

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


class Run(NamedTuple):
    """One viewpoint set of one home.

    Attributes:
        home: name of the scene.
        cell_width: spacing of the viewpoints, metres.
        number: of the set.
    """

    home: str
    cell_width: float
    number: int


class Looks(NamedTuple):
    """How the viewpoints of runs are drawn: the seed and how many random headings each gets."""

    seed: int
    orientations: int

    def key(self, observer: Observer, run: Run) -> dict[str, Any]:
        """What the views of a run depend on."""
        return {"views": observer.view_key(run.home), "run": list(run), "looks": list(self)}


def runs_of(homes: Sequence[str], cell_widths: Sequence[float], viewpoint_sets: int) -> list[Run]:
    """All runs: every home, cell width and viewpoint set."""
    places = product(homes, map(float, cell_widths), range(viewpoint_sets))
    return [Run(home, width, number) for home, width, number in places]


def render(pool: ScenePool, runs: Sequence[Run], looks: Looks, silent: bool) -> None:
    """Put the views of all runs into the cache, those of each home in its worker; what is there already stays.

    Args:
        pool: renders.
        runs: whose views are wanted.
        looks: how they are drawn.
        silent: show no progress, since something else does.
    """
    missing: dict[str, list[Run]] = {}
    for run in runs:
        if pool.observer.cache.load(KIND, looks.key(pool.observer, run)) is None:
            missing.setdefault(run.home, []).append(run)
    tasks = [pool.submit(_render_home, home, home_runs, looks) for home, home_runs in missing.items()]
    for task in tasks if silent or not tasks else progress(tasks, "views from sparse viewpoints (homes)"):
        task.result()


def views_of(observer: Observer, run: Run, looks: Looks) -> Views:
    """The views of one run, in viewpoint order, then orientation.

    Beside what `stack` gives: for each viewpoint snap_distance, how far it was moved to free space, metres.
    """
    return observer.cache.get_or_build(KIND, looks.key(observer, run), lambda: _look(observer, run, looks))


def _render_home(observer: Observer, scene: str, runs: Sequence[Run], looks: Looks) -> None:
    for run in runs:
        views_of(observer, run, looks)


def _look(observer: Observer, run: Run, looks: Looks) -> Views:
    # widths in millimetres, since seeds are integers
    rng = np.random.default_rng(
        [looks.seed, Stream.VIEWPOINTS, crc32(run.home.encode()), round(run.cell_width * 1000), run.number]
    )
    viewpoints = sparse_viewpoints(observer.scene(run.home).free_space, run.cell_width, rng)
    headings = rng.uniform(-np.pi, np.pi, (len(viewpoints.snapped), looks.orientations))
    poses = [
        Pose(float(x), float(y), float(theta))
        for (x, y), turns in zip(viewpoints.snapped, headings, strict=True)
        for theta in turns
    ]
    x, y = observer.truth(run.home).points[0].tolist()
    somewhere = Pose(x, y, 0.0)  # gives the arrays of an empty set their shapes
    arrays = stack([observer.observe(run.home, pose, rng) for pose in poses or [somewhere]])
    views = {name: values[: len(poses)] for name, values in arrays.items()}
    return {**views, "snap_distance": viewpoints.distance}
