"""Evaluation on single views: the map of each approach from one view, compared with its label V_label."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from imagination.evaluation import record_files
from imagination.evaluation.approaches import CONTROLS, REFERENCE
from imagination.evaluation.metrics import count, iou
from imagination.evaluation.protocol import MappingProtocol, ModelUnderTest, scenes_with
from imagination.evaluation.records import SelectedThresholds
from imagination.evaluation.threshold_selection import THRESHOLDS, confusion_counts
from imagination.evaluation.trials import Trial, ViewpointSampling, render, trials_of, views_of
from imagination.ground_truth.targets import label
from imagination.mapping.predictor import ViewEvidence
from imagination.utils.atomic_io import write_npz, write_text
from imagination.utils.errors import UserError, check_range
from imagination.utils.tabular import Row, to_csv
from imagination.views.collector import Views

MIN_LABEL = 0.1
"""Minimum label area of a ranked view, square metres; with a smaller label, a single cell decides the IoU."""

RANKS = ("best", "median", "worst")
"""Ranks of the views in the figures."""

CELLS = ("all", "seen", "unseen")
"""Subsets of cells for the counts of the network's probabilities: all, seen by depth, not seen."""

FILE = "single_views.npz"
"""Name of the file, in the folder of the results, with the views for the figures."""

TABLE = "thresholds.csv"
"""Name of the file, in records/, with correct, false-positive and ground-truth cells at every threshold."""


class SingleView(NamedTuple):
    """One view and the map of each approach from it, with the threshold and kernel selected for global maps.

    Attributes:
        rank: best, median or worst by IoU of the ranking approach; see `ranked_by`.
        category: name of the category.
        scene: name of the scene.
        pose: x, y (metres) and heading (radians) of the robot.
        iou: IoU of the ranking approach.
        rgb: colour image.
        seen: V_seen.
        occupied: egocentric occupancy.
        label: V_label.
        probabilities: probabilities of the unit; NaN without a unit.
        predicted: predicted map by approach.
    """

    rank: str
    category: str
    scene: str
    pose: Float64[np.ndarray, "3"]
    iou: float
    rgb: UInt8[np.ndarray, "h w 3"]
    seen: Bool[np.ndarray, "v v"]
    occupied: Bool[np.ndarray, "v v"]
    label: Bool[np.ndarray, "v v"]
    probabilities: Float32[np.ndarray, "v v"]
    predicted: dict[str, Bool[np.ndarray, "v v"]]


class SingleViews(NamedTuple):
    """Results on single views.

    Attributes:
        shown: best, median and worst view of each category.
        counts: correct, false-positive and ground-truth cells by approach and category at `THRESHOLDS`, over all views.
        cells: the same counts of the unit's probabilities by subset of `CELLS` and category; empty without a unit.
        views: number of views.
        resolution: metres per cell.
    """

    shown: list[SingleView]
    counts: dict[tuple[str, str], Int64[np.ndarray, "t 3"]]
    cells: dict[tuple[str, str], Int64[np.ndarray, "t 3"]]
    views: int
    resolution: float


class _Ranked(NamedTuple):
    """View as a candidate for the figures: its IoU, number of label cells, trial, and index in the trial."""

    iou: float
    size: int
    trial: Trial
    view_index: int


def ranked_by(approaches: Sequence[str]) -> str:
    """Return the approach whose IoU ranks the views: imagination if evaluated, else the last one not in `CONTROLS`."""
    ranking = [name for name in approaches if name not in CONTROLS]
    return REFERENCE if REFERENCE in approaches else (ranking or list(approaches))[-1]


def evaluate_single_views(
    protocol: MappingProtocol,
    model: ModelUnderTest,
    scenes: Sequence[str],
    selected: SelectedThresholds,
    imaginable: int,
) -> SingleViews:
    """Evaluate each view of every scene's first viewpoint set at the smallest cell width.

    Args:
        protocol: approaches and sampling of viewpoints.
        model: networks and worker processes.
        scenes: names of the test scenes.
        selected: threshold and kernel of each approach and category.
        imaginable: dilation kernel δ of V_label, cells.

    Raises:
        UserError: if no scene contains one of the categories.
    """
    present = scenes_with(model, scenes)
    sampling = ViewpointSampling(protocol.seed, protocol.orientations)
    trials = trials_of(scenes, [min(protocol.cell_widths)], 1)
    render(model.pool, trials, sampling, silent=True)
    names, observer = list(protocol.approaches), model.pool.observer
    empty = np.zeros((len(THRESHOLDS), 3), np.int64)
    counts = {(name, category): empty.copy() for category in present for name in names}
    has_unit = "maps" in model.predict.gives
    cells = {(subset, category): empty.copy() for category in present for subset in CELLS if has_unit}
    ranked: dict[str, list[_Ranked]] = {category: [] for category in present}
    num_views = 0
    for trial in trials:
        views = views_of(observer, trial, sampling)
        if not len(views["pose"]):
            continue
        num_views += len(views["pose"])
        for view in _views(protocol, model, views, selected, imaginable):
            score = view.scores[ranked_by(names)]
            for name in names:
                counts[name, view.category] += confusion_counts(view.scores[name], view.label, THRESHOLDS)
            for subset, mask in zip(CELLS, (view.seen | True, view.seen, ~view.seen), strict=True):
                if has_unit:
                    inside = np.where(mask, view.probabilities, np.float32(0))
                    cells[subset, view.category] += confusion_counts(inside, view.label & mask, THRESHOLDS)
            predicted = score >= np.float32(selected[ranked_by(names), view.category].threshold)
            view_iou = float(iou(count(predicted, view.label)))
            ranked[view.category].append(_Ranked(view_iou, int(view.label.sum()), trial, view.view_index))
    shown = []
    for category, candidates in ranked.items():
        for rank, pick in picks(candidates, model.setting.ego.resolution).items():
            views = views_of(observer, pick.trial, sampling)
            for view in _views(protocol, model, views, selected, imaginable):
                if (view.category, view.view_index) == (category, pick.view_index):
                    shown.append(_shown(view, rank, pick, views, selected))
    return SingleViews(shown, counts, cells, num_views, model.setting.ego.resolution)


def picks(views: Sequence[_Ranked], resolution: float) -> dict[str, _Ranked]:
    """Return the best, median and worst view with a label of at least `MIN_LABEL`; ties go to the largest label.

    If no label is that large, all views with a label are ranked; the result is empty if no view has a label.
    """
    large = [view for view in views if view.size * resolution**2 >= MIN_LABEL]
    ranked = sorted(large or [view for view in views if view.size], key=lambda view: (view.iou, -view.size))
    if not ranked:
        return {}
    best = max(ranked, key=lambda view: (view.iou, view.size))
    return dict(zip(RANKS, (best, ranked[len(ranked) // 2], ranked[0]), strict=True))


class _View(NamedTuple):
    """One view and category, with the score map of each approach after postprocessing."""

    category: str
    view_index: int
    seen: Bool[np.ndarray, "v v"]
    label: Bool[np.ndarray, "v v"]
    probabilities: Float32[np.ndarray, "v v"]
    scores: dict[str, Float32[np.ndarray, "v v"]]


def _views(
    protocol: MappingProtocol,
    model: ModelUnderTest,
    views: Views,
    selected: SelectedThresholds,
    imaginable: int,
) -> Iterator[_View]:
    """Yield each view once per category, with the score maps of all approaches."""
    setting = model.setting
    needs = {need for approach in protocol.approaches.values() if (need := approach.evidence.needs)}
    predictions = model.predict(views, (needs | {"maps"}) & model.predict.gives)
    labels = label(views["object"][:, setting.layers], views["seen"][:, None], imaginable)
    by_source: dict[object, ViewEvidence] = {}
    for approach in protocol.approaches.values():
        if approach.evidence not in by_source:
            by_source[approach.evidence] = approach.evidence(views, predictions, setting)
    has_unit = "maps" in model.predict.gives
    probabilities = predictions["maps"] if has_unit else np.full(labels.shape, np.nan, np.float32)
    for layer, category in enumerate(setting.categories):
        for index in range(len(views["pose"])):
            scores = {}
            for name, approach in protocol.approaches.items():
                evidence = by_source[approach.evidence]
                score = np.where(evidence.mask[index, layer], evidence.values[index, layer], np.float32(0))
                kernel = selected[name, category].kernel
                scores[name] = approach.apply_postprocess(
                    score, labels[index, layer], kernel, setting.ego.resolution
                )
            yield _View(
                category,
                index,
                views["seen"][index],
                labels[index, layer],
                probabilities[index, layer],
                scores,
            )


def _shown(view: _View, rank: str, ranked: _Ranked, views: Views, selected: SelectedThresholds) -> SingleView:
    """Return a view for the figures, with its predicted maps."""
    predicted = {
        name: score >= np.float32(selected[name, view.category].threshold)
        for name, score in view.scores.items()
    }
    return SingleView(
        rank, view.category, ranked.trial.scene, views["pose"][view.view_index], ranked.iou,
        views["rgb"][view.view_index], view.seen, views["occupied"][view.view_index], view.label, view.probabilities,
        predicted,
    )  # fmt: skip


def threshold_rows(results: SingleViews) -> list[Row]:
    """Return the rows of thresholds.csv: counts by threshold for each approach, and for the network by `CELLS`."""
    groups: list[tuple[str, str, str, Int64[np.ndarray, "t 3"]]] = [
        *((name, "all", category, counts) for (name, category), counts in results.counts.items()),
        *(("network", subset, category, counts) for (subset, category), counts in results.cells.items()),
    ]
    return [
        {
            "approach": name,
            "cells": subset,
            "category": category,
            "views": str(results.views),
            "threshold": f"{threshold:.2f}",
            "correct_cells": str(correct),
            "false_positives": str(false),
            "gt_cells": str(gt),
        }
        for name, subset, category, counts in groups
        for threshold, (correct, false, gt) in zip(THRESHOLDS.tolist(), counts.tolist(), strict=True)
    ]


def to_arrays(results: SingleViews) -> dict[str, np.ndarray]:
    """Return the shown views as arrays with a leading axis; `predicted` has a second axis for `approaches`."""
    shown = results.shown
    names = list(shown[0].predicted) if shown else []
    arrays = {
        field: np.stack([np.asarray(getattr(view, field)) for view in shown]) if shown else np.zeros(0)
        for field in SingleView._fields
        if field != "predicted"
    }
    predicted = [np.stack([view.predicted[name] for name in names]) for view in shown]
    return {
        **arrays,
        "predicted": np.stack(predicted) if predicted else np.zeros(0),
        "approaches": np.array(names, dtype=np.str_),
        "resolution": np.array(results.resolution),
    }


def from_arrays(arrays: Mapping[str, np.ndarray]) -> list[SingleView]:
    """Return the views whose arrays `to_arrays` returned."""
    names = arrays["approaches"].tolist()
    fields = [field for field in SingleView._fields if field != "predicted"]
    return [
        SingleView(
            **{field: _item(arrays[field][index]) for field in fields},
            predicted=dict(zip(names, arrays["predicted"][index], strict=True)),
        )
        for index in range(len(arrays["rank"]))
    ]


def write(folder: Path, results: SingleViews) -> None:
    """Write records/thresholds.csv and single_views.npz into the folder of the results, each atomically."""
    write_text(folder / record_files.FOLDER / TABLE, to_csv(threshold_rows(results)))
    write_npz(folder / FILE, to_arrays(results))


def load(path: Path) -> tuple[list[SingleView], float]:
    """Read single_views.npz and return the views and the resolution, metres per cell.

    Raises:
        UserError: if the file is missing, damaged or not a file of single views.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        views = [_checked(view) for view in from_arrays(arrays)]
        return views, check_range("resolution", float(arrays["resolution"]), 0.005, 1.0)
    except Exception as error:  # zip, zlib and NumPy raise various exceptions on damaged files
        raise UserError(
            f"single views: {path} cannot be read ({error}); run the evaluation again to write it"
        ) from error


def _checked(view: SingleView) -> SingleView:
    """Check types and shapes of the arrays and return the view.

    Raises:
        UserError: if an array has an unexpected type or shape; the message names the first one.
    """
    size = view.label.shape[0]
    maps = {"seen": view.seen, "occupied": view.occupied, "label": view.label, **view.predicted}
    expected = [
        ("rgb", view.rgb, "uint8", (*view.rgb.shape[:2], 3)),
        ("probabilities", view.probabilities, "float32", (size, size)),
        *((name, array, "bool", (size, size)) for name, array in maps.items()),
    ]
    for name, array, kind, shape in expected:
        if (array.dtype, array.shape) != (np.dtype(kind), shape) or not array.size:
            raise UserError(f"{name}: got {array.dtype} of shape {array.shape}, expected {kind} of {shape}")
    names = [view.rank, view.category, view.scene, *view.predicted]
    if not view.predicted or not all(isinstance(name, str) for name in names):
        raise UserError(f"rank, category, scene, approaches: got {names}, expected names as text")
    return view


def _item(value: Any) -> Any:
    """Convert a NumPy scalar to a Python value; return arrays unchanged."""
    return value.item() if isinstance(value, np.generic) else value
