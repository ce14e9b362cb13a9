"""The mapping task of the paper: global maps from sparse viewpoints, compared with the truth of the whole home.

Thresholds and kernels are chosen on validation homes, then every home, cell width and viewpoint set of the test split
is measured. Nothing here knows what kind of network predicts.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int64

from imagination.errors import UserError, check_range
from imagination.evaluation.approaches import Approach, Setting
from imagination.evaluation.maps import Area, area_of, score_maps
from imagination.evaluation.metrics import count
from imagination.evaluation.outcome import Choices, Counts, Example, Key, Report
from imagination.evaluation.runs import Looks, Run, render, runs_of, views_of
from imagination.evaluation.selection import THRESHOLDS, choose, tally
from imagination.progress import progress
from imagination.views.collector import Views
from imagination.views.pool import ScenePool

Predict = Callable[[Views], Float32[np.ndarray, "n c v v"]]
"""The network: probabilities of the evaluated categories for each view."""

Scores = dict[str, Float32[np.ndarray, "c h w"]]
"""The map of each approach before its threshold."""


class Subject(NamedTuple):
    """What is evaluated, and on which homes' worker processes.

    Attributes:
        pool: renders views; holds the observer.
        setting: camera, grid and categories.
        predict: the network.
    """

    pool: ScenePool
    setting: Setting
    predict: Predict


class _RunMaps(NamedTuple):
    run: Run
    views: Views
    probabilities: Float32[np.ndarray, "n c v v"]
    area: Area
    scores: Scores


@dataclass(frozen=True)
class MappingProtocol:
    """How mapping is evaluated.

    Attributes:
        approaches: by name, in the order of the table.
        cell_widths: spacings of the viewpoints, metres.
        viewpoint_sets: random sets for each home and cell width.
        orientations: random headings at each viewpoint.
        seed: of viewpoints, headings, shuffling and bootstrap.
        resamples: of homes, for intervals.
    """

    approaches: Mapping[str, Approach]
    cell_widths: Sequence[float]
    viewpoint_sets: int
    orientations: int
    seed: int
    resamples: int

    def __post_init__(self) -> None:
        check_range("evaluation.cell_widths", len(self.cell_widths), 1, 100, "widths")
        for width in self.cell_widths:
            check_range("evaluation.cell_widths", width, 0.25, 50.0, "m")
        check_range("evaluation.viewpoint_sets", self.viewpoint_sets, 1, 10_000)
        check_range("evaluation.orientations", self.orientations, 1, 1000)
        check_range("evaluation.resamples", self.resamples, 10, 10_000_000)
        check_range("evaluation.approaches", len(self.approaches), 1, 1000, "approaches")

    def choose(self, subject: Subject, homes: Sequence[str], silent: bool = False) -> Choices:
        """Choose threshold and kernel of each approach by pooled IoU over all runs of `homes` together.

        Raises:
            UserError: if a category is in none of the homes.
        """
        present = homes_with(subject, homes)
        totals: dict[tuple[str, str], Int64[np.ndarray, "kernels t 3"]] = {
            (name, category): np.zeros((len(approach.kernels), len(THRESHOLDS), 3), np.int64)
            for category in present
            for name, approach in self.approaches.items()
        }
        for maps in self._maps(subject, homes, "global maps of validation homes", silent):
            for layer, category in _layers(maps.run, present):
                for name, approach in self.approaches.items():
                    for index, kernel in enumerate(approach.kernels):
                        score = approach.finished(maps.scores[name][layer], kernel, maps.area.grid.resolution)
                        totals[name, category][index] += tally(score, maps.area.truth[layer], THRESHOLDS)
        return {
            (name, category): choose(tallies, self.approaches[name].kernels, THRESHOLDS)
            for (name, category), tallies in totals.items()
        }

    def measure(
        self, subject: Subject, homes: Sequence[str], choices: Choices, silent: bool = False
    ) -> Report:
        """Measure every approach on all runs of `homes`.

        Raises:
            UserError: if a category is in none of the homes.
        """
        present = homes_with(subject, homes)
        rng = np.random.default_rng(self.seed)
        counts: Counts = {
            Key(*key): [] for key in product(self.approaches, present, map(float, self.cell_widths))
        }
        shuffled: Counts = {key: [] for key in counts}
        examples: list[Example] = []
        snaps = []
        for maps in self._maps(subject, homes, "global maps of test homes", silent):
            run, area, poses = maps.run, maps.area, maps.views["pose"]
            snaps.append(maps.views["snap_distance"])
            in_random_order = self._scores(
                maps.views, maps.probabilities, subject, area, rng.permutation(len(poses))
            )
            for layer, category in _layers(run, present):
                predicted = self._predicted(maps.scores, choices, layer, category, area)
                reordered = self._predicted(in_random_order, choices, layer, category, area)
                for name in self.approaches:
                    key = Key(name, category, run.cell_width)
                    counts[key].append(count(predicted[name], area.truth[layer]))
                    shuffled[key].append(count(reordered[name], area.truth[layer]))
                if run.number == 0 and run.home == present[category][0]:
                    shown = area.grid, area.occupied, area.truth[layer], predicted, poses
                    examples.append(Example(run, category, *shown))
        return Report(
            self._by_home(counts),
            self._by_home(shuffled),
            choices,
            present,
            {category: [home for home in homes if home not in names] for category, names in present.items()},
            examples,
            snaps,
        )

    def _maps(self, subject: Subject, homes: Sequence[str], title: str, silent: bool) -> Iterator[_RunMaps]:
        """The maps of every run of `homes`: home by home, then by cell width and viewpoint set."""
        runs, looks = (
            runs_of(homes, self.cell_widths, self.viewpoint_sets),
            Looks(self.seed, self.orientations),
        )
        render(subject.pool, runs, looks, silent)
        observer, setting = subject.pool.observer, subject.setting
        margin = max(kernel for approach in self.approaches.values() for kernel in approach.kernels)
        for run in runs if silent else progress(runs, title):
            views = views_of(observer, run, looks)
            probabilities = self._predict(subject, views)
            area = area_of(observer.truth(run.home), setting.layers, views["pose"], setting.ego, margin)
            scores = self._scores(views, probabilities, subject, area, np.arange(len(views["pose"])))
            yield _RunMaps(run, views, probabilities, area, scores)

    def _predict(self, subject: Subject, views: Views) -> Float32[np.ndarray, "n c v v"]:
        if len(views["pose"]):
            return subject.predict(views)
        size = subject.setting.ego.cells
        return np.zeros((0, len(subject.setting.layers), size, size), np.float32)

    def _scores(
        self,
        views: Views,
        probabilities: Float32[np.ndarray, "n c v v"],
        subject: Subject,
        area: Area,
        order: Int64[np.ndarray, " n"],
    ) -> Scores:
        return score_maps(views, probabilities, self.approaches, subject.setting, area.grid, order)

    def _predicted(
        self, scores: Scores, choices: Choices, layer: int, category: str, area: Area
    ) -> dict[str, Bool[np.ndarray, "h w"]]:
        """The map of each approach, finished and thresholded as chosen."""
        predicted = {}
        for name, approach in self.approaches.items():
            choice = choices[name, category]
            score = approach.finished(scores[name][layer], choice.kernel, area.grid.resolution)
            predicted[name] = score >= np.float32(choice.threshold)
        return predicted

    def _by_home(self, counts: Counts) -> dict[Key, Int64[np.ndarray, "homes sets 3"]]:
        return {key: np.stack(rows).reshape(-1, self.viewpoint_sets, 3) for key, rows in counts.items()}


def homes_with(subject: Subject, homes: Sequence[str]) -> dict[str, list[str]]:
    """For each evaluated category, those of the homes that contain it.

    Raises:
        UserError: if a category is in none of them.
    """
    observer, setting = subject.pool.observer, subject.setting
    present = {
        category: [home for home in homes if observer.truth(home).truth[layer].any()]
        for category, layer in zip(setting.categories, setting.layers, strict=True)
    }
    for category, names in present.items():
        if not names:
            raise UserError(
                f"category {category!r}: none of the {len(homes)} homes to evaluate contains one "
                f"({', '.join(homes[:5])}{' …' if len(homes) > 5 else ''}); choose another category or more homes"
            )
    return present


def _layers(run: Run, present: Mapping[str, Sequence[str]]) -> Iterator[tuple[int, str]]:
    """Layer and name of each category that the run's home contains."""
    return ((layer, name) for layer, (name, homes) in enumerate(present.items()) if run.home in homes)
