"""The work on one run: its maps, and what is counted in them. Called in the worker process that holds the scene."""

from collections.abc import Mapping
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from imagination.evaluation.approaches import Approach, Predictions, Setting
from imagination.evaluation.global_maps import Area, area_of, score_maps, seen_map
from imagination.evaluation.metrics import count
from imagination.evaluation.records import SelectedThresholds
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.threshold_selection import THRESHOLDS, confusion_counts, reached
from imagination.evaluation.trials import Trial, ViewpointSampling, views_of
from imagination.geometry.grid import Grid
from imagination.utils.cache import as_plain
from imagination.views.collector import Views
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream

Arrays = dict[str, np.ndarray]

Scores = Mapping[str, Float32[np.ndarray, "c h w"]]
"""The map of each approach before its threshold."""


class Plan(NamedTuple):
    """What is done with every run.

    Attributes:
        approaches: by name.
        setting: camera, grid and categories.
        looks: how views were drawn.
    """

    approaches: Mapping[str, Approach]
    setting: Setting
    sampling: ViewpointSampling

    @property
    def needs(self) -> set[str]:
        """What the approaches need of networks."""
        return {need for approach in self.approaches.values() if (need := approach.evidence.needs)}

    def key(self, observer: Observer, trial: Trial) -> dict[str, Any]:
        """What a run's maps depend on beside the networks, as plain values."""
        views = self.sampling.key(observer, trial)
        return {
            "views": views,
            "approaches": as_plain(self.approaches),
            "categories": self.setting.categories,
        }

    def area(self, observer: Observer, trial: Trial, views: Views) -> Area:
        """The part of the scene that the run can write to."""
        margin = max(kernel for approach in self.approaches.values() for kernel in approach.kernels)
        truth = observer.truth(trial.scene)
        return area_of(truth, self.setting.layers, views["pose"], self.setting.ego, margin)


def count_trial(observer: Observer, scene: str, trial: Trial, plan: Plan, predictions: Predictions) -> Arrays:
    """Counts of every approach, category, kernel and threshold, [c k t 3] for each approach: what is chosen from."""
    views = views_of(observer, trial, plan.sampling)
    area = plan.area(observer, trial, views)
    scores = score_maps(
        views, predictions, plan.approaches, plan.setting, area.grid, np.arange(len(views["pose"]))
    )
    tallies = {}
    for name, approach in plan.approaches.items():
        tallies[name] = np.stack(
            [
                [
                    confusion_counts(
                        approach.apply_postprocess(layer, truth, kernel, area.grid.resolution),
                        truth,
                        THRESHOLDS,
                    )
                    for kernel in approach.kernels
                ]
                for layer, truth in zip(scores[name], area.truth, strict=True)
            ]
        )
    return tallies


def evaluate_trial(
    observer: Observer,
    scene: str,
    trial: Trial,
    plan: Plan,
    choices: SelectedThresholds,
    predictions: Predictions,
) -> Arrays:
    """The finished maps of a run and their counts.

    Returns:
        Of the fields of `SavedMaps`, those that are arrays, and resolution and origin; counts, in seen cells alone
        (counts_seen), and with views registered in a random order (counts_shuffled), [a c 3] each; snap_distance of
        the viewpoints; first_person [c 2], pixels in which the predicted segmentation and the true one agree on the
        category and in which either has it, without a segmentation network 0.
    """
    views = views_of(observer, trial, plan.sampling)
    area = plan.area(observer, trial, views)
    number = len(views["pose"])
    width = round(trial.cell_width * 1000)  # millimetres, since seeds are integers
    seed = [plan.sampling.seed, Stream.REGISTRATION_ORDER, crc32(trial.scene.encode()), width, trial.number]
    orders = np.arange(number), np.random.default_rng(seed).permutation(number)
    levels = [
        _levels(
            score_maps(views, predictions, plan.approaches, plan.setting, area.grid, order),
            plan,
            area,
            choices,
        )
        for order in orders
    ]
    threshold = _thresholds(plan, choices)
    predicted, shuffled = (level >= threshold[..., None, None] for level in levels)
    seen = seen_map(views, plan.setting.ego, area.grid)
    return {
        "level": levels[0],
        "threshold": threshold,
        "truth": area.truth,
        "present": np.asarray(observer.truth(scene).truth[plan.setting.layers].any(axis=(1, 2))),
        "seen": seen,
        "occupied": area.occupied,
        "poses": views["pose"],
        "resolution": np.array(area.grid.resolution),
        "origin": np.array(area.grid.origin),
        "counts": _counts(predicted, area.truth),
        "counts_seen": _counts(predicted & seen, area.truth & seen),
        "counts_shuffled": _counts(shuffled, area.truth),
        "snap_distance": views["snap_distance"],
        "first_person": _agreement(views["categories"], predictions.get("images"), plan.setting.layers),
    }


def maps_of(trial: Trial, plan: Plan, arrays: Arrays) -> SavedMaps:
    """The maps among what `evaluate_trial` gave."""
    x, y = arrays["origin"].tolist()
    rows, columns = arrays["seen"].shape
    grid = Grid(float(arrays["resolution"]), rows, columns, (x, y))
    held = {name: arrays[name] for name in SavedMaps._fields if name in arrays}
    return SavedMaps(trial, list(plan.approaches), list(plan.setting.categories), **held, grid=grid)


def _levels(
    scores: Scores, plan: Plan, area: Area, choices: SelectedThresholds
) -> UInt8[np.ndarray, "a c h w"]:
    """How many of `THRESHOLDS` each cell of the finished maps reaches; nothing where a category has no choice."""
    levels = np.zeros((len(plan.approaches), *area.truth.shape), np.uint8)
    for place, (name, approach) in enumerate(plan.approaches.items()):
        for layer, category in enumerate(plan.setting.categories):
            kernel = choices[name, category].kernel
            score = approach.apply_postprocess(
                scores[name][layer], area.truth[layer], kernel, area.grid.resolution
            )
            levels[place, layer] = reached(score, THRESHOLDS)
    return levels


def _thresholds(plan: Plan, choices: SelectedThresholds) -> UInt8[np.ndarray, "a c"]:
    """In hundredths."""
    return np.array(
        [
            [round(100 * choices[name, category].threshold) for category in plan.setting.categories]
            for name in plan.approaches
        ],
        np.uint8,
    )


def _counts(
    predicted: Bool[np.ndarray, "a c h w"], truth: Bool[np.ndarray, "c h w"]
) -> Int64[np.ndarray, "a c 3"]:
    return np.array(
        [[count(layer, true) for layer, true in zip(maps, truth, strict=True)] for maps in predicted]
    )


def _agreement(
    truth: UInt8[np.ndarray, "n h w"], predicted: UInt8[np.ndarray, "n h w"] | None, layers: list[int]
) -> Int64[np.ndarray, "c 2"]:
    if predicted is None:
        return np.zeros((len(layers), 2), np.int64)
    pairs = [(truth == layer + 1, predicted == layer + 1) for layer in layers]
    return np.array([[np.count_nonzero(one & other), np.count_nonzero(one | other)] for one, other in pairs])
