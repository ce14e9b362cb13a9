"""Single predictions: what each approach says about one view alone, against V_label."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from imagination.evaluation.approaches import NO_RIVALS, REFERENCE
from imagination.evaluation.metrics import count, iou
from imagination.evaluation.protocol import MappingProtocol, ModelUnderTest, scenes_with
from imagination.evaluation.records import SelectedThresholds
from imagination.evaluation.threshold_selection import THRESHOLDS, confusion_counts
from imagination.evaluation.trials import Trial, ViewpointSampling, render, trials_of, views_of
from imagination.ground_truth.targets import label
from imagination.mapping.predictor import ViewEvidence
from imagination.utils.atomic_io import replacing, write_text
from imagination.utils.errors import UserError, check_range
from imagination.utils.tabular import Row, to_csv
from imagination.views.collector import Views

MIN_LABEL = 0.1
"""Smallest label of a view that is ranked, square metres: of less, one cell decides."""

RANKS = ("best", "median", "worst")

CELLS = ("all", "seen", "unseen")
"""Cells over which the network's probabilities are counted: all, those that depth saw, the others."""

FILE = "single_views.npz"
"""In a run's folder: the views shown."""

TABLE = "thresholds.csv"
"""In tables/: correct, false and truth cells of single views at every threshold."""


class SingleView(NamedTuple):
    """One view and what each approach draws from it alone, with its threshold and kernel of the global map.

    Attributes:
        rank: best, median or worst by IoU of the approach in `ranked_by`.
        category, scene: which.
        pose: x, y, θ of the robot.
        iou: of that approach.
        rgb: what the camera saw.
        seen, occupied, label: V_seen, egocentric occupancy and V_label.
        probabilities: the unit's; not a number without one.
        predicted: the map of each approach.
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


class Singles(NamedTuple):
    """What was found out about single views.

    Attributes:
        shown: best, median and worst of each category.
        tallies: correct, false and truth cells of each approach and category at `THRESHOLDS`, over all views.
        cells: the same of the unit's probabilities, for each of `CELLS` and category; empty without one.
        views: how many were looked at.
        resolution: metres per cell.
    """

    shown: list[SingleView]
    tallies: dict[tuple[str, str], Int64[np.ndarray, "t 3"]]
    cells: dict[tuple[str, str], Int64[np.ndarray, "t 3"]]
    views: int
    resolution: float


class _Place(NamedTuple):
    """A view that is ranked: highest IoU first, then the largest label."""

    iou: float
    size: int
    trial: Trial
    at: int


def ranked_by(approaches: Sequence[str]) -> str:
    """The approach whose IoU ranks the views: imagination; without it the last that is not told the truth."""
    fair = [name for name in approaches if name not in NO_RIVALS]
    return REFERENCE if REFERENCE in approaches else (fair or list(approaches))[-1]


def evaluate_single_views(
    protocol: MappingProtocol,
    subject: ModelUnderTest,
    scenes: Sequence[str],
    choices: SelectedThresholds,
    imaginable: int,
) -> Singles:
    """Look at the views of each scene's first viewpoint set of the smallest cell width one by one.

    Args:
        protocol: whose approaches and views are taken.
        subject: what is evaluated.
        scenes: of the test split.
        choices: threshold and kernel of each approach and category.
        imaginable: kernel δ of V_label, cells.

    Raises:
        UserError: if a category is in none of the scenes.
    """
    present = scenes_with(subject, scenes)
    sampling = ViewpointSampling(protocol.seed, protocol.orientations)
    trials = trials_of(scenes, [min(protocol.cell_widths)], 1)
    render(subject.pool, trials, sampling, silent=True)
    names, observer = list(protocol.approaches), subject.pool.observer
    empty = np.zeros((len(THRESHOLDS), 3), np.int64)
    tallies = {(name, category): empty.copy() for category in present for name in names}
    imagined = "maps" in subject.predict.gives
    cells = {(part, category): empty.copy() for category in present for part in CELLS if imagined}
    places: dict[str, list[_Place]] = {category: [] for category in present}
    views = 0
    for trial in trials:
        seen_here = views_of(observer, trial, sampling)
        if not len(seen_here["pose"]):
            continue
        views += len(seen_here["pose"])
        for view in _views(protocol, subject, seen_here, choices, imaginable):
            truth, score = view.label, view.scores[ranked_by(names)]
            for name in names:
                tallies[name, view.category] += confusion_counts(view.scores[name], truth, THRESHOLDS)
            for part, mask in zip(CELLS, (view.seen | True, view.seen, ~view.seen), strict=True):
                if imagined:
                    inside = np.where(mask, view.probabilities, np.float32(0))
                    cells[part, view.category] += confusion_counts(inside, truth & mask, THRESHOLDS)
            predicted = score >= np.float32(choices[ranked_by(names), view.category].threshold)
            value = float(iou(count(predicted, truth)))
            places[view.category].append(_Place(value, int(truth.sum()), trial, view.at))
    shown = []
    for category, ranked in places.items():
        for rank, place in picks(ranked, subject.setting.ego.resolution).items():
            kept = views_of(observer, place.trial, sampling)
            for view in _views(protocol, subject, kept, choices, imaginable):
                if (view.category, view.at) == (category, place.at):
                    shown.append(_shown(view, rank, place, kept, choices))
    return Singles(shown, tallies, cells, views, subject.setting.ego.resolution)


def picks(places: Sequence[_Place], resolution: float) -> dict[str, _Place]:
    """The best, median and worst of the views with a label of at least `MIN_LABEL`; of equals that with the most label.

    Where no label is that large, of those with any; empty where there is none.
    """
    enough = [place for place in places if place.size * resolution**2 >= MIN_LABEL]
    ranked = sorted(
        enough or [place for place in places if place.size], key=lambda place: (place.iou, -place.size)
    )
    if not ranked:
        return {}
    best = max(ranked, key=lambda place: (place.iou, place.size))
    return dict(zip(RANKS, (best, ranked[len(ranked) // 2], ranked[0]), strict=True))


class _View(NamedTuple):
    """One view of one category: the score of each approach, finished as chosen."""

    category: str
    at: int
    seen: Bool[np.ndarray, "v v"]
    label: Bool[np.ndarray, "v v"]
    probabilities: Float32[np.ndarray, "v v"]
    scores: dict[str, Float32[np.ndarray, "v v"]]


def _views(
    protocol: MappingProtocol,
    subject: ModelUnderTest,
    views: Views,
    choices: SelectedThresholds,
    imaginable: int,
) -> Iterator[_View]:
    setting = subject.setting
    needs = {need for approach in protocol.approaches.values() if (need := approach.evidence.needs)}
    predictions = subject.predict(views, (needs | {"maps"}) & subject.predict.gives)
    labels = label(views["object"][:, setting.layers], views["seen"][:, None], imaginable)
    statements: dict[object, ViewEvidence] = {}
    for approach in protocol.approaches.values():
        if approach.evidence not in statements:
            statements[approach.evidence] = approach.evidence(views, predictions, setting)
    imagined = "maps" in subject.predict.gives
    probabilities = predictions["maps"] if imagined else np.full(labels.shape, np.nan, np.float32)
    for layer, category in enumerate(setting.categories):
        for index in range(len(views["pose"])):
            scores = {}
            for name, approach in protocol.approaches.items():
                said = statements[approach.evidence]
                score = np.where(said.mask[index, layer], said.values[index, layer], np.float32(0))
                kernel = choices[name, category].kernel
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


def _shown(view: _View, rank: str, place: _Place, views: Views, choices: SelectedThresholds) -> SingleView:
    predicted = {
        name: score >= np.float32(choices[name, view.category].threshold)
        for name, score in view.scores.items()
    }
    return SingleView(
        rank, view.category, place.trial.scene, views["pose"][view.at], place.iou, views["rgb"][view.at], view.seen,
        views["occupied"][view.at], view.label, view.probabilities, predicted,
    )  # fmt: skip


def threshold_rows(singles: Singles) -> list[Row]:
    """Counts of single views at every threshold: of each approach, and of the network over `CELLS`."""
    groups: list[tuple[str, str, str, Int64[np.ndarray, "t 3"]]] = [
        *((name, "all", category, counts) for (name, category), counts in singles.tallies.items()),
        *(("network", part, category, counts) for (part, category), counts in singles.cells.items()),
    ]
    return [
        {
            "approach": name,
            "cells": part,
            "category": category,
            "views": str(singles.views),
            "threshold": f"{threshold:.2f}",
            "correct_cells": str(correct),
            "false_positives": str(false),
            "gt_cells": str(truth),
        }
        for name, part, category, counts in groups
        for threshold, (correct, false, truth) in zip(THRESHOLDS.tolist(), counts.tolist(), strict=True)
    ]


def to_arrays(singles: Singles) -> dict[str, np.ndarray]:
    """The views shown as arrays with a leading axis, `predicted` with one more for `approaches`."""
    shown = singles.shown
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
        "resolution": np.array(singles.resolution),
    }


def from_arrays(arrays: Mapping[str, np.ndarray]) -> list[SingleView]:
    """The views that `to_arrays` made arrays of."""
    names = arrays["approaches"].tolist()
    fields = [field for field in SingleView._fields if field != "predicted"]
    return [
        SingleView(
            **{field: _item(arrays[field][index]) for field in fields},
            predicted=dict(zip(names, arrays["predicted"][index], strict=True)),
        )
        for index in range(len(arrays["rank"]))
    ]


def write(folder: Path, singles: Singles) -> None:
    """Write tables/thresholds.csv and the views shown into a run's folder, each whole or not at all."""
    write_text(folder / "tables" / TABLE, to_csv(threshold_rows(singles)))
    with replacing(folder / FILE) as temporary:
        np.savez_compressed(temporary, **to_arrays(singles))  # type: ignore[arg-type]


def load(path: Path) -> tuple[list[SingleView], float]:
    """The views shown and the metres per cell, from a run's folder.

    Raises:
        UserError: if it is no file of single views.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        views = [_checked(view) for view in from_arrays(arrays)]
        return views, check_range("resolution", float(arrays["resolution"]), 0.005, 1.0)
    except Exception as error:  # zip, zlib and NumPy raise anything on a damaged file
        raise UserError(f"single views {path}: is damaged ({error}); evaluate again to make it") from error


def _checked(view: SingleView) -> SingleView:
    """The same, if its arrays are what they should be.

    Raises:
        UserError: with the first that is not.
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
        raise UserError(f"rank, category, scene, approaches: got {names}, expected names")
    return view


def _item(value: Any) -> Any:
    """An element of an array as Python has it; arrays as they are."""
    return value.item() if isinstance(value, np.generic) else value
