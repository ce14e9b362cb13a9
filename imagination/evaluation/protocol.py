"""Mapping task of the paper: global maps from sparse viewpoints, compared with the ground truth of the whole scene.

Thresholds and kernels are selected on validation scenes; then every scene, cell width and viewpoint set of the test
split is evaluated. The protocol does not depend on the kind of network.
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
from imagination.evaluation.trial_worker import Arrays, TrialPlan, count_trial, evaluate_trial, maps_of
from imagination.evaluation.trials import Trial, ViewpointSampling, render, trials_of, views_of
from imagination.utils.cache import code_version
from imagination.utils.cache_key import as_plain
from imagination.utils.errors import UserError, check_choice, check_range, first_of
from imagination.utils.precision import PRECISIONS
from imagination.utils.progress import progress
from imagination.views.collector import Views
from imagination.views.scene_workers import ScenePool

KIND = "evaluation_results"
"""Kind of the cache entries that hold the results of a trial."""

COUNTED = "counts", "counts_shuffled", "counts_seen", "snap_distance", "first_person"
"""Arrays of a trial that stay in memory until all trials are evaluated; maps do not."""

PACKAGES = ("mapping",)
"""Packages whose code determines the results of a trial, besides those in every key of the cache."""


@runtime_checkable
class Predict(Protocol):
    """Interface of the networks under test, such as `Predictor`."""

    @property
    def gives(self) -> frozenset[str]:
        """Predictions that the networks provide, a subset of `NEEDS`."""

    @property
    def fingerprint(self) -> str:
        """Hash of everything except the views that the predictions depend on."""

    def __call__(self, views: Views, wanted: Collection[str]) -> Predictions:
        """Predict those of `NEEDS` that are in `wanted` for each view."""


class ModelUnderTest(NamedTuple):
    """Networks under test and the worker processes of the scenes.

    Attributes:
        pool: worker processes that render views and evaluate maps; holds the observer.
        setting: camera, grid and categories.
        predict: networks under test.
        keep: whether to cache the result of each trial, so that an interrupted evaluation continues.
    """

    pool: ScenePool
    setting: Setting
    predict: Predict
    keep: bool = True


@dataclass(frozen=True)
class MappingProtocol:
    """Protocol of the mapping evaluation.

    Attributes:
        approaches: approaches by name, in the order of the table.
        cell_widths: spacings of the viewpoints, metres.
        viewpoint_sets: random viewpoint sets for each scene and cell width.
        orientations: random headings at each viewpoint.
        seed: seed of viewpoints, headings, shuffling and bootstrap.
        resamples: bootstrap resamples of scenes for the intervals.
        only: names of the approaches to evaluate; None for all whose networks are available.
        known_scenes: number of additional scenes with training furniture that were not trained on.
        precision: floating-point precision of the predictions, one of `PRECISIONS`.
        threshold: threshold of every global map, in whole hundredths; None to select it on validation scenes.
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
        if len({f"{width:g}" for width in self.cell_widths}) < len(self.cell_widths):  # as in names of files
            raise UserError(
                f"evaluation.cell_widths: got {list(self.cell_widths)}, expected each width once; remove the "
                "duplicates"
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
        as_plain(
            self.approaches
        )  # refuses what has no key, and reads code that may be edited during an evaluation

    def available(self, gives: Collection[str]) -> "MappingProtocol":
        """Return the protocol with only the approaches whose network predictions are in `gives`.

        Raises:
            UserError: if an approach that `only` names lacks its network, or no approach is left.
        """
        names = list(self.approaches) if self.only is None else list(self.only)
        for name in names:
            check_choice("evaluation.only", name, self.approaches)
        needs = {name: self.approaches[name].evidence.needs for name in names}
        missing = [name for name, need in needs.items() if need is not None and need not in gives]
        if missing and (self.only is not None or len(missing) == len(names)):
            raise UserError(
                f"evaluation.only: got {missing[0]}, which needs {NEEDS[needs[missing[0]] or '']}; add it "
                "(ckpt=[one,other] takes several), or leave the approach out"
            )
        return replace(
            self, approaches={name: self.approaches[name] for name in names if name not in missing}
        )

    def select_thresholds(
        self, model: ModelUnderTest, scenes: Sequence[str], silent: bool = False
    ) -> SelectedThresholds:
        """Select threshold and kernel of each approach by IoU pooled over all trials of `scenes`.

        Raises:
            UserError: if a category is in none of the scenes.
        """
        present = scenes_with(model, scenes)
        totals: dict[tuple[str, str], Int64[np.ndarray, "kernels t 3"]] = {
            (name, category): np.zeros((len(approach.kernels), len(THRESHOLDS), 3), np.int64)
            for category in present
            for name, approach in self.approaches.items()
        }
        for trial, counts in self._each(
            model, scenes, count_trial, (), "global maps of validation scenes", silent
        ):
            for (name, category), total in totals.items():
                if trial.scene in present[category]:
                    total += counts[name][model.setting.categories.index(category)]
        allowed = np.s_[:] if self.threshold is None else np.isclose(THRESHOLDS, self.threshold)
        return {
            (name, category): select_threshold(
                counts[:, allowed], self.approaches[name].kernels, THRESHOLDS[allowed]
            )
            for (name, category), counts in totals.items()
        }

    def evaluate(
        self,
        model: ModelUnderTest,
        scenes: Sequence[str],
        selected: SelectedThresholds,
        silent: bool = False,
        save: Callable[[SavedMaps], None] = lambda maps: None,
        title: str = "global maps of test scenes",
    ) -> Report:
        """Evaluate every approach on all trials of `scenes`.

        Args:
            model: networks and worker processes.
            scenes: names of the scenes.
            selected: threshold and kernel of each approach and category.
            silent: whether to show no progress bar.
            save: callback that receives the maps of each trial.
            title: title of the progress bar.

        Raises:
            UserError: if a category is in none of the scenes.
        """
        present = scenes_with(model, scenes)
        plan, categories = self._plan(model), model.setting.categories
        evaluated: list[tuple[Trial, Arrays]] = []
        examples: list[Example] = []
        for trial, arrays in self._each(model, scenes, evaluate_trial, (selected,), title, silent):
            maps = maps_of(trial, plan, arrays)
            save(maps.cropped())
            evaluated.append((trial, {name: arrays[name] for name in COUNTED}))
            examples += [
                maps.example(layer)
                for layer, category in enumerate(categories)
                if trial.number == 0 and trial.scene == present[category][0]
            ]
        return Report(
            self._by_key("counts", evaluated, categories, present),
            self._by_key("counts_shuffled", evaluated, categories, present),
            selected,
            present,
            {
                category: [scene for scene in scenes if scene not in names]
                for category, names in present.items()
            },
            examples,
            [arrays["snap_distance"] for _, arrays in evaluated],
            self._by_key("counts_seen", evaluated, categories, present),
            _first_person_iou(evaluated, categories) if "images" in plan.needs else {},
        )

    def _by_key(
        self,
        kind: str,
        evaluated: Sequence[tuple[Trial, Arrays]],
        categories: Sequence[str],
        present: Mapping[str, Sequence[str]],
    ) -> Counts:
        """Return counts of one kind by row of the table, over the scenes that contain the category."""
        counts = {}
        for (place, name), (layer, category), width in product(
            enumerate(self.approaches), enumerate(categories), map(float, self.cell_widths)
        ):
            rows = [
                arrays[kind][place, layer]
                for trial, arrays in evaluated
                if trial.cell_width == width and trial.scene in present[category]
            ]
            counts[Key(name, category, width)] = np.stack(rows).reshape(-1, self.viewpoint_sets, 3)
        return counts

    def _plan(self, model: ModelUnderTest) -> TrialPlan:
        return TrialPlan(self.approaches, model.setting, ViewpointSampling(self.seed, self.orientations))

    def _each(
        self,
        model: ModelUnderTest,
        scenes: Sequence[str],
        task: Callable[..., Arrays],
        arguments: tuple[Any, ...],
        title: str,
        silent: bool,
    ) -> Iterator[tuple[Trial, Arrays]]:
        """Yield the result of `task` for every trial, ordered by scene, cell width and viewpoint set.

        The networks predict in this process while the workers of the scenes run the tasks. Results are cached.
        """
        plan, trials = self._plan(model), trials_of(scenes, self.cell_widths, self.viewpoint_sets)
        render(model.pool, trials, plan.sampling, silent)
        observer, cache = model.pool.observer, model.pool.observer.cache
        networks = model.predict.fingerprint if model.keep else ""
        waiting: deque[tuple[dict[str, Any], Future[Arrays] | Arrays]] = deque()

        def start(trial: Trial) -> tuple[dict[str, Any], Future[Arrays] | Arrays]:
            job = {"task": task.__name__, "arguments": repr(arguments), "networks": networks}
            key = {**job, **plan.key(observer, trial), "code": code_version(PACKAGES)}
            if model.keep and (cached := cache.load(KIND, key)) is not None:
                return key, cached
            predictions = self._predict(model, plan, views_of(observer, trial, plan.sampling))
            return key, model.pool.submit(task, trial.scene, trial, plan, *arguments, predictions)

        for place, trial in enumerate(trials if silent else progress(trials, title)):
            waiting.extend(map(start, trials[place + len(waiting) : place + 1 + model.pool.ahead]))
            key, result = waiting.popleft()
            if isinstance(result, Future):
                result = result.result()
                if model.keep:
                    cache.store(KIND, key, result)
            yield trial, result

    def _predict(self, model: ModelUnderTest, plan: TrialPlan, views: Views) -> Predictions:
        """Predict for the views of a trial; an empty viewpoint set gives arrays of length 0."""
        if len(views["pose"]):
            return model.predict(views, plan.needs)
        size, setting = model.setting.ego.cells, model.setting
        maps = np.zeros((0, len(setting.layers), size, size), np.float32)
        return dict.fromkeys(NEEDS, maps) | {"images": views["categories"]}


def _first_person_iou(
    evaluated: Sequence[tuple[Trial, Arrays]], categories: Sequence[str]
) -> dict[str, float]:
    """Return the IoU of the predicted segmentation over all images, for each category."""
    zero = np.zeros((len(categories), 2), np.int64)
    pixels = sum((arrays["first_person"] for _, arrays in evaluated), zero)
    return {
        name: intersection / max(union, 1)
        for name, (intersection, union) in zip(categories, pixels.tolist(), strict=True)
    }


def scenes_with(model: ModelUnderTest, scenes: Sequence[str]) -> dict[str, list[str]]:
    """Return the scenes that contain each evaluated category.

    Raises:
        UserError: if a category is in none of the scenes.
    """
    observer, setting = model.pool.observer, model.setting
    present = {
        category: [scene for scene in scenes if observer.ground_truth(scene).truth[layer].any()]
        for category, layer in zip(setting.categories, setting.layers, strict=True)
    }
    for category, names in present.items():
        if not names:
            raise UserError(
                f"category {category!r}: none of the {len(scenes)} scenes to evaluate contains one "
                f"({first_of(scenes)}); evaluate another category or more scenes"
            )
    return present
