"""Evaluation of one trial in the worker process of its scene: its global maps and their confusion counts."""

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
from imagination.utils.cache_key import as_plain
from imagination.views.collector import Views
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream

Arrays = dict[str, np.ndarray]

Scores = Mapping[str, Float32[np.ndarray, "c h w"]]
"""Score map of each approach, before its threshold."""


class TrialPlan(NamedTuple):
    """Settings of the evaluation of every trial.

    Attributes:
        approaches: approaches by name.
        setting: camera, grid and categories.
        sampling: draw of the viewpoints.
    """

    approaches: Mapping[str, Approach]
    setting: Setting
    sampling: ViewpointSampling

    @property
    def needs(self) -> set[str]:
        """Network predictions that the approaches need."""
        return {need for approach in self.approaches.values() if (need := approach.evidence.needs)}

    def key(self, observer: Observer, trial: Trial) -> dict[str, Any]:
        """Return the part of a trial's cache key that does not depend on the networks, as plain values."""
        return {
            "views": self.sampling.key(observer, trial),
            "approaches": as_plain(list(self.approaches.items())),  # arrays have their order
            "categories": self.setting.categories,
        }

    def area(self, observer: Observer, trial: Trial, views: Views) -> Area:
        """Return the part of the scene that the views of the trial can reach."""
        margin = max(kernel for approach in self.approaches.values() for kernel in approach.kernels)
        gt = observer.ground_truth(trial.scene)
        return area_of(gt, self.setting.layers, views["pose"], self.setting.ego, margin)


def count_trial(
    observer: Observer, scene: str, trial: Trial, plan: TrialPlan, predictions: Predictions
) -> Arrays:
    """Count pixels for threshold selection: [c, k, t, 3] by category, kernel and threshold for each approach."""
    views = views_of(observer, trial, plan.sampling)
    area = plan.area(observer, trial, views)
    scores = score_maps(
        views, predictions, plan.approaches, plan.setting, area.grid, np.arange(len(views["pose"]))
    )
    counts = {}
    for name, approach in plan.approaches.items():
        counts[name] = np.stack(
            [
                [
                    confusion_counts(
                        approach.apply_postprocess(layer, gt, kernel, area.grid.resolution),
                        gt,
                        THRESHOLDS,
                    )
                    for kernel in approach.kernels
                ]
                for layer, gt in zip(scores[name], area.truth, strict=True)
            ]
        )
    return counts


def evaluate_trial(
    observer: Observer,
    scene: str,
    trial: Trial,
    plan: TrialPlan,
    selected: SelectedThresholds,
    predictions: Predictions,
) -> Arrays:
    """Compute the postprocessed maps of a trial and their counts.

    Returns:
        the array fields of `SavedMaps`, resolution and origin; counts over whole maps (counts), over seen cells
        (counts_seen) and with views registered in a random order (counts_shuffled), [a, c, 3] each; snap_distance of
        the viewpoints; first_person [c, 2], pixels in the intersection and in the union of predicted and ground-truth
        segmentation (0 without a segmentation network).
    """
    views = views_of(observer, trial, plan.sampling)
    area = plan.area(observer, trial, views)
    number = len(views["pose"])
    width = round(trial.cell_width * 1000)  # millimetres: seeds are integers
    seed = [plan.sampling.seed, Stream.REGISTRATION_ORDER, crc32(trial.scene.encode()), width, trial.number]
    orders = np.arange(number), np.random.default_rng(seed).permutation(number)
    levels = [
        _levels(
            score_maps(views, predictions, plan.approaches, plan.setting, area.grid, order),
            plan,
            area,
            selected,
        )
        for order in orders
    ]
    threshold = _thresholds(plan, selected)
    predicted, shuffled = (level >= threshold[..., None, None] for level in levels)
    seen = seen_map(views, plan.setting.ego, area.grid)
    return {
        "level": levels[0],
        "threshold": threshold,
        "truth": area.truth,
        "present": np.asarray(observer.ground_truth(scene).truth[plan.setting.layers].any(axis=(1, 2))),
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


def maps_of(trial: Trial, plan: TrialPlan, arrays: Arrays) -> SavedMaps:
    """Return the maps in the arrays of `evaluate_trial`."""
    x, y = arrays["origin"].tolist()
    rows, columns = arrays["seen"].shape
    grid = Grid(float(arrays["resolution"]), rows, columns, (x, y))
    fields = {name: arrays[name] for name in SavedMaps._fields if name in arrays}
    return SavedMaps(trial, list(plan.approaches), list(plan.setting.categories), **fields, grid=grid)


def _levels(
    scores: Scores, plan: TrialPlan, area: Area, selected: SelectedThresholds
) -> UInt8[np.ndarray, "a c h w"]:
    """Return the number of `THRESHOLDS` that each cell of the postprocessed maps reaches."""
    levels = np.zeros((len(plan.approaches), *area.truth.shape), np.uint8)
    for place, (name, approach) in enumerate(plan.approaches.items()):
        for layer, category in enumerate(plan.setting.categories):
            kernel = selected[name, category].kernel
            score = approach.apply_postprocess(
                scores[name][layer], area.truth[layer], kernel, area.grid.resolution
            )
            levels[place, layer] = reached(score, THRESHOLDS)
    return levels


def _thresholds(plan: TrialPlan, selected: SelectedThresholds) -> UInt8[np.ndarray, "a c"]:
    """Return the selected thresholds in hundredths."""
    return np.array(
        [
            [round(100 * selected[name, category].threshold) for category in plan.setting.categories]
            for name in plan.approaches
        ],
        np.uint8,
    )


def _counts(
    predicted: Bool[np.ndarray, "a c h w"], gt: Bool[np.ndarray, "c h w"]
) -> Int64[np.ndarray, "a c 3"]:
    return np.array(
        [[count(layer, gt_layer) for layer, gt_layer in zip(maps, gt, strict=True)] for maps in predicted]
    )


def _agreement(
    gt: UInt8[np.ndarray, "n h w"], predicted: UInt8[np.ndarray, "n h w"] | None, layers: list[int]
) -> Int64[np.ndarray, "c 2"]:
    """Count the pixels in intersection and union of two segmentations, for each category."""
    if predicted is None:
        return np.zeros((len(layers), 2), np.int64)
    pairs = [(gt == layer + 1, predicted == layer + 1) for layer in layers]
    return np.array([[np.count_nonzero(a & b), np.count_nonzero(a | b)] for a, b in pairs])
