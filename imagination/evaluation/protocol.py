"""The mapping task of the paper: global maps from sparse viewpoints, compared with the truth of the whole home.

Thresholds and kernels are chosen on validation homes, then every home, cell width and viewpoint set of the test split
is measured. Nothing here knows what kind of network predicts.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64

from imagination.evaluation.approaches import NEEDS, Approach, Predictions, Setting
from imagination.evaluation.records import Choices, Counts, Example, Key, Report
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.threshold_selection import THRESHOLDS, choose
from imagination.evaluation.trial_worker import Arrays, Plan, maps_of, measure_run, tally_run
from imagination.evaluation.trials import Looks, Run, render, runs_of, views_of
from imagination.utils.errors import UserError, check_choice, check_range, first_of
from imagination.utils.precision import PRECISIONS
from imagination.utils.progress import progress
from imagination.views.collector import Views
from imagination.views.scene_workers import ScenePool

KIND = "evaluation_results"
"""Name of finished runs in the cache."""

COUNTED = "counts", "counts_shuffled", "counts_seen", "snap_distance", "first_person"
"""What is kept of every run's arrays until all are there; its maps are not."""


@runtime_checkable
class Predict(Protocol):
    """The networks, as `Predictor` holds them."""

    @property
    def gives(self) -> frozenset[str]:
        """Which of `NEEDS` it fulfils."""

    @property
    def fingerprint(self) -> str:
        """Changes with everything that its answers depend on, beside the views."""

    def __call__(self, views: Views, wanted: Collection[str]) -> Predictions:
        """Those of `NEEDS` that are wanted, for each view."""


class Subject(NamedTuple):
    """What is evaluated, and on which homes' worker processes.

    Attributes:
        pool: renders views and measures maps; holds the observer.
        setting: camera, grid and categories.
        predict: the networks.
        keep: put what each run gave into the cache, so that an evaluation which stops goes on where it was.
    """

    pool: ScenePool
    setting: Setting
    predict: Predict
    keep: bool = True


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
        only: names of the approaches to evaluate; None for all that the networks at hand suffice for.
        known_homes: how many homes with furniture as in training, none of which is trained on, are measured as well.
        precision: what networks answer in, one of `PRECISIONS`.
        threshold: of every global map, a whole number of hundredths; None for each approach's best on validation homes.
    """

    approaches: Mapping[str, Approach]
    cell_widths: Sequence[float]
    viewpoint_sets: int
    orientations: int
    seed: int
    resamples: int
    only: Sequence[str] | None = None
    known_homes: int = 0
    precision: str = "32-true"
    threshold: float | None = None

    def __post_init__(self) -> None:
        check_range("evaluation.cell_widths", len(self.cell_widths), 1, 100, "widths")
        for width in self.cell_widths:
            check_range("evaluation.cell_widths", width, 0.25, 50.0, "m")
        if len(set(map(float, self.cell_widths))) < len(self.cell_widths):
            raise UserError(
                f"evaluation.cell_widths: got {list(self.cell_widths)}, expected each width once; leave out those that "
                "are given again"
            )
        check_range("evaluation.viewpoint_sets", self.viewpoint_sets, 1, 10_000)
        check_range("evaluation.orientations", self.orientations, 1, 1000)
        check_range("evaluation.resamples", self.resamples, 10, 10_000_000)
        check_range("evaluation.known_homes", self.known_homes, 0, 9999, "homes")
        if self.threshold is not None and self.threshold not in THRESHOLDS.astype(np.float64).round(2):
            raise UserError(
                f"evaluation.threshold: got {self.threshold}, expected 0.01, 0.02, … 0.99, or null"
            )
        check_choice("evaluation.precision", self.precision, PRECISIONS)
        check_range("evaluation.approaches", len(self.approaches), 1, 1000, "approaches")

    def available(self, gives: Collection[str]) -> "MappingProtocol":
        """The same with those of the approaches that the networks at hand suffice for.

        Raises:
            UserError: if an approach that `only` names needs another network, or none is left.
        """
        names = list(self.approaches) if self.only is None else list(self.only)
        for name in names:
            check_choice("evaluation.only", name, self.approaches)
        needs = {name: self.approaches[name].evidence.needs for name in names}
        lacking = [name for name, need in needs.items() if need is not None and need not in gives]
        if lacking and (self.only is not None or len(lacking) == len(names)):
            raise UserError(
                f"evaluation.only: got {lacking[0]}, which needs {NEEDS[needs[lacking[0]] or '']}; add it "
                "(ckpt=[one,other] takes several), or leave the approach out"
            )
        return replace(
            self, approaches={name: self.approaches[name] for name in names if name not in lacking}
        )

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
        for run, tallies in self._each(
            subject, homes, tally_run, (), "global maps of validation homes", silent
        ):
            for (name, category), total in totals.items():
                if run.home in present[category]:
                    total += tallies[name][subject.setting.categories.index(category)]
        allowed = np.s_[:] if self.threshold is None else np.isclose(THRESHOLDS, self.threshold)
        return {
            (name, category): choose(tallies[:, allowed], self.approaches[name].kernels, THRESHOLDS[allowed])
            for (name, category), tallies in totals.items()
        }

    def measure(
        self,
        subject: Subject,
        homes: Sequence[str],
        choices: Choices,
        silent: bool = False,
        save: Callable[[SavedMaps], None] = lambda maps: None,
        title: str = "global maps of test homes",
    ) -> Report:
        """Measure every approach on all runs of `homes`.

        Args:
            subject: what is measured.
            homes: names of scenes.
            choices: threshold and kernel of each approach and category.
            silent: show no progress.
            save: called with the maps of each run.
            title: of the progress shown.

        Raises:
            UserError: if a category is in none of the homes.
        """
        present = homes_with(subject, homes)
        plan, categories = self._plan(subject), subject.setting.categories
        measured: list[tuple[Run, Arrays]] = []
        examples: list[Example] = []
        for run, arrays in self._each(subject, homes, measure_run, (choices,), title, silent):
            maps = maps_of(run, plan, arrays)
            save(maps.cropped())
            measured.append((run, {name: arrays[name] for name in COUNTED}))
            examples += [
                maps.example(layer)
                for layer, category in enumerate(categories)
                if run.number == 0 and run.home == present[category][0]
            ]
        return Report(
            self._by_key("counts", measured, categories, present),
            self._by_key("counts_shuffled", measured, categories, present),
            choices,
            present,
            {category: [home for home in homes if home not in names] for category, names in present.items()},
            examples,
            [arrays["snap_distance"] for _, arrays in measured],
            self._by_key("counts_seen", measured, categories, present),
            _ratios(measured, categories) if "images" in plan.needs else {},
        )

    def _by_key(
        self,
        kind: str,
        measured: Sequence[tuple[Run, Arrays]],
        categories: Sequence[str],
        present: Mapping[str, Sequence[str]],
    ) -> Counts:
        """Counts of one kind, of the homes that contain the category."""
        counts = {}
        for (place, name), (layer, category), width in product(
            enumerate(self.approaches), enumerate(categories), map(float, self.cell_widths)
        ):
            rows = [
                arrays[kind][place, layer]
                for run, arrays in measured
                if run.cell_width == width and run.home in present[category]
            ]
            counts[Key(name, category, width)] = np.stack(rows).reshape(-1, self.viewpoint_sets, 3)
        return counts

    def _plan(self, subject: Subject) -> Plan:
        return Plan(self.approaches, subject.setting, Looks(self.seed, self.orientations))

    def _each(
        self,
        subject: Subject,
        homes: Sequence[str],
        task: Callable[..., Arrays],
        arguments: tuple[Any, ...],
        title: str,
        silent: bool,
    ) -> Iterator[tuple[Run, Arrays]]:
        """What `task` gives of every run: home by home, then by cell width and viewpoint set.

        Networks predict here, the workers of the homes do the rest meanwhile. Finished runs are kept in the cache.
        """
        plan, runs = self._plan(subject), runs_of(homes, self.cell_widths, self.viewpoint_sets)
        render(subject.pool, runs, plan.looks, silent)
        observer, cache = subject.pool.observer, subject.pool.observer.cache
        networks = subject.predict.fingerprint if subject.keep else ""
        waiting: deque[tuple[dict[str, Any], Future[Arrays] | Arrays]] = deque()

        def start(run: Run) -> tuple[dict[str, Any], Future[Arrays] | Arrays]:
            own = {"task": task.__name__, "arguments": repr(arguments), "networks": networks}
            key = {**own, **plan.key(observer, run)}
            if subject.keep and (kept := cache.load(KIND, key)) is not None:
                return key, kept
            predictions = self._predict(subject, plan, views_of(observer, run, plan.looks))
            return key, subject.pool.submit(task, run.home, run, plan, *arguments, predictions)

        for place, run in enumerate(runs if silent else progress(runs, title)):
            waiting.extend(map(start, runs[place + len(waiting) : place + 1 + subject.pool.ahead]))
            key, result = waiting.popleft()
            if isinstance(result, Future):
                result = result.result()
                if subject.keep:
                    cache.store(KIND, key, result)
            yield run, result

    def _predict(self, subject: Subject, plan: Plan, views: Views) -> Predictions:
        if len(views["pose"]):
            return subject.predict(views, plan.needs)
        size, setting = subject.setting.ego.cells, subject.setting
        maps = np.zeros((0, len(setting.layers), size, size), np.float32)
        return dict.fromkeys(NEEDS, maps) | {"images": views["categories"]}


def _ratios(measured: Sequence[tuple[Run, Arrays]], categories: Sequence[str]) -> dict[str, float]:
    """IoU of the predicted segmentation of all images, for each category."""
    pixels = sum((arrays["first_person"] for _, arrays in measured), np.zeros((len(categories), 2), np.int64))
    return {
        name: both / max(either, 1) for name, (both, either) in zip(categories, pixels.tolist(), strict=True)
    }


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
                f"({first_of(homes)}); choose another category or more homes"
            )
    return present
