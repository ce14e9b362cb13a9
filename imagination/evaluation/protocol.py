"""The mapping task of the paper: global maps from sparse viewpoints, compared with the truth of the whole scene.

Thresholds and kernels are chosen on validation scenes, then every scene, cell width and viewpoint set of the test split
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
from imagination.evaluation.records import Counts, Example, Key, Report, SelectedThresholds
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.threshold_selection import THRESHOLDS, select_threshold
from imagination.evaluation.trial_worker import Arrays, Plan, count_trial, evaluate_trial, maps_of
from imagination.evaluation.trials import Trial, ViewpointSampling, render, trials_of, views_of
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


class ModelUnderTest(NamedTuple):
    """What is evaluated, and on which scenes' worker processes.

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
        viewpoint_sets: random sets for each scene and cell width.
        orientations: random headings at each viewpoint.
        seed: of viewpoints, headings, shuffling and bootstrap.
        resamples: of scenes, for intervals.
        only: names of the approaches to evaluate; None for all that the networks at hand suffice for.
        known_scenes: how many scenes with furniture as in training, none of which is trained on, are measured as well.
        precision: what networks answer in, one of `PRECISIONS`.
        threshold: of every global map, a whole number of hundredths; None for each approach's best on validation scenes.
    """

    approaches: Mapping[str, Approach]
    cell_widths: Sequence[float]
    viewpoint_sets: int
    orientations: int
    seed: int
    resamples: int
    only: Sequence[str] | None = None
    known_scenes: int = 0
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
        check_range("evaluation.known_scenes", self.known_scenes, 0, 9999, "scenes")
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

    def select_thresholds(
        self, subject: ModelUnderTest, scenes: Sequence[str], silent: bool = False
    ) -> SelectedThresholds:
        """Choose threshold and kernel of each approach by pooled IoU over all runs of `scenes` together.

        Raises:
            UserError: if a category is in none of the scenes.
        """
        present = scenes_with(subject, scenes)
        totals: dict[tuple[str, str], Int64[np.ndarray, "kernels t 3"]] = {
            (name, category): np.zeros((len(approach.kernels), len(THRESHOLDS), 3), np.int64)
            for category in present
            for name, approach in self.approaches.items()
        }
        for trial, tallies in self._each(
            subject, scenes, count_trial, (), "global maps of validation scenes", silent
        ):
            for (name, category), total in totals.items():
                if trial.scene in present[category]:
                    total += tallies[name][subject.setting.categories.index(category)]
        allowed = np.s_[:] if self.threshold is None else np.isclose(THRESHOLDS, self.threshold)
        return {
            (name, category): select_threshold(
                tallies[:, allowed], self.approaches[name].kernels, THRESHOLDS[allowed]
            )
            for (name, category), tallies in totals.items()
        }

    def evaluate(
        self,
        subject: ModelUnderTest,
        scenes: Sequence[str],
        choices: SelectedThresholds,
        silent: bool = False,
        save: Callable[[SavedMaps], None] = lambda maps: None,
        title: str = "global maps of test scenes",
    ) -> Report:
        """Measure every approach on all runs of `scenes`.

        Args:
            subject: what is measured.
            scenes: names of scenes.
            choices: threshold and kernel of each approach and category.
            silent: show no progress.
            save: called with the maps of each run.
            title: of the progress shown.

        Raises:
            UserError: if a category is in none of the scenes.
        """
        present = scenes_with(subject, scenes)
        plan, categories = self._plan(subject), subject.setting.categories
        measured: list[tuple[Trial, Arrays]] = []
        examples: list[Example] = []
        for trial, arrays in self._each(subject, scenes, evaluate_trial, (choices,), title, silent):
            maps = maps_of(trial, plan, arrays)
            save(maps.cropped())
            measured.append((trial, {name: arrays[name] for name in COUNTED}))
            examples += [
                maps.example(layer)
                for layer, category in enumerate(categories)
                if trial.number == 0 and trial.scene == present[category][0]
            ]
        return Report(
            self._by_key("counts", measured, categories, present),
            self._by_key("counts_shuffled", measured, categories, present),
            choices,
            present,
            {
                category: [scene for scene in scenes if scene not in names]
                for category, names in present.items()
            },
            examples,
            [arrays["snap_distance"] for _, arrays in measured],
            self._by_key("counts_seen", measured, categories, present),
            _ratios(measured, categories) if "images" in plan.needs else {},
        )

    def _by_key(
        self,
        kind: str,
        measured: Sequence[tuple[Trial, Arrays]],
        categories: Sequence[str],
        present: Mapping[str, Sequence[str]],
    ) -> Counts:
        """Counts of one kind, of the scenes that contain the category."""
        counts = {}
        for (place, name), (layer, category), width in product(
            enumerate(self.approaches), enumerate(categories), map(float, self.cell_widths)
        ):
            rows = [
                arrays[kind][place, layer]
                for trial, arrays in measured
                if trial.cell_width == width and trial.scene in present[category]
            ]
            counts[Key(name, category, width)] = np.stack(rows).reshape(-1, self.viewpoint_sets, 3)
        return counts

    def _plan(self, subject: ModelUnderTest) -> Plan:
        return Plan(self.approaches, subject.setting, ViewpointSampling(self.seed, self.orientations))

    def _each(
        self,
        subject: ModelUnderTest,
        scenes: Sequence[str],
        task: Callable[..., Arrays],
        arguments: tuple[Any, ...],
        title: str,
        silent: bool,
    ) -> Iterator[tuple[Trial, Arrays]]:
        """What `task` gives of every run: scene by scene, then by cell width and viewpoint set.

        Networks predict here, the workers of the scenes do the rest meanwhile. Finished runs are kept in the cache.
        """
        plan, trials = self._plan(subject), trials_of(scenes, self.cell_widths, self.viewpoint_sets)
        render(subject.pool, trials, plan.sampling, silent)
        observer, cache = subject.pool.observer, subject.pool.observer.cache
        networks = subject.predict.fingerprint if subject.keep else ""
        waiting: deque[tuple[dict[str, Any], Future[Arrays] | Arrays]] = deque()

        def start(trial: Trial) -> tuple[dict[str, Any], Future[Arrays] | Arrays]:
            own = {"task": task.__name__, "arguments": repr(arguments), "networks": networks}
            key = {**own, **plan.key(observer, trial)}
            if subject.keep and (kept := cache.load(KIND, key)) is not None:
                return key, kept
            predictions = self._predict(subject, plan, views_of(observer, trial, plan.sampling))
            return key, subject.pool.submit(task, trial.scene, trial, plan, *arguments, predictions)

        for place, trial in enumerate(trials if silent else progress(trials, title)):
            waiting.extend(map(start, trials[place + len(waiting) : place + 1 + subject.pool.ahead]))
            key, result = waiting.popleft()
            if isinstance(result, Future):
                result = result.result()
                if subject.keep:
                    cache.store(KIND, key, result)
            yield trial, result

    def _predict(self, subject: ModelUnderTest, plan: Plan, views: Views) -> Predictions:
        if len(views["pose"]):
            return subject.predict(views, plan.needs)
        size, setting = subject.setting.ego.cells, subject.setting
        maps = np.zeros((0, len(setting.layers), size, size), np.float32)
        return dict.fromkeys(NEEDS, maps) | {"images": views["categories"]}


def _ratios(measured: Sequence[tuple[Trial, Arrays]], categories: Sequence[str]) -> dict[str, float]:
    """IoU of the predicted segmentation of all images, for each category."""
    pixels = sum((arrays["first_person"] for _, arrays in measured), np.zeros((len(categories), 2), np.int64))
    return {
        name: both / max(either, 1) for name, (both, either) in zip(categories, pixels.tolist(), strict=True)
    }


def scenes_with(subject: ModelUnderTest, scenes: Sequence[str]) -> dict[str, list[str]]:
    """For each evaluated category, those of the scenes that contain it.

    Raises:
        UserError: if a category is in none of them.
    """
    observer, setting = subject.pool.observer, subject.setting
    present = {
        category: [scene for scene in scenes if observer.truth(scene).truth[layer].any()]
        for category, layer in zip(setting.categories, setting.layers, strict=True)
    }
    for category, names in present.items():
        if not names:
            raise UserError(
                f"category {category!r}: none of the {len(scenes)} scenes to evaluate contains one "
                f"({first_of(scenes)}); choose another category or more scenes"
            )
    return present
