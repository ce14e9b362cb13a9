"""Figures of scores: IoU bars, distributions, precision over recall, reliability, ablations."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imagination.evaluation.metrics import iou
from imagination.evaluation.records import Key
from imagination.reporting import style
from imagination.reporting.load_run import ConfusionCounts, Runs
from imagination.utils.tabular import Row


def draw_iou(rows: Sequence[Row]) -> Figure:
    """Pooled IoU of each approach by cell width, with its interval, one panel for each category."""
    categories = list(dict.fromkeys(row["category"] for row in rows))
    names = list(dict.fromkeys(row["approach"] for row in rows))
    widths = sorted({float(row["cell_width"]) for row in rows}, reverse=True)
    figure = Figure(figsize=(1 + 4 * len(categories), 3.4), layout="constrained")
    axes = figure.subplots(1, len(categories), squeeze=False, sharey=True)[0]
    bar, colours = 0.8 / len(names), style.colours(names)
    for axis, category in zip(axes, categories, strict=True):
        for place, name in enumerate(names):
            chosen = {
                float(r["cell_width"]): r for r in rows if (r["category"], r["approach"]) == (category, name)
            }
            value, low, high = (
                np.array([float(chosen[width][column]) for width in widths])
                for column in ("iou_pooled", "iou_ci_low", "iou_ci_high")
            )
            error = np.maximum(np.stack([value - low, high - value]), 0)
            axis.bar(
                np.arange(len(widths)) + (place + 0.5) * bar - 0.4,
                value,
                bar,
                yerr=error,
                capsize=2,
                color=colours[name],
                ecolor=mpl.rcParams["text.color"],
                label=style.label(name),
            )
        axis.set_xticks(range(len(widths)), [f"{width:g}" for width in widths])
        axis.set_xlabel("cell width, m")
        axis.set_title(category)
    axes[0].set_ylabel("pooled IoU")
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=1 + len(categories),
    )
    return figure


BINS = 10
"""Of predicted probabilities, in a figure of reliability."""

CELLS = {"all": "all cells", "seen": "cells that depth saw", "unseen": "other cells"}
"""Kinds of cells, and how they are named."""

CELL_COLOURS = {"all": "#777777", "seen": "#0072b2", "unseen": "#d55e00"}

Point = tuple[str, float, float, float]
"""What was swept, as text; the value, and its interval."""


def draw_distribution(counts: Mapping[Key, Runs], category: str, measure: str) -> Figure:
    """A box for each approach and cell width: the runs' IoU, or their correct pixels, with every run as a dot.

    Boxes span the quartiles, whiskers reach the last run within 1.5 times that.
    """
    keys = [key for key in counts if key.category == category]
    names = list(dict.fromkeys(key.approach for key in keys))
    widths = sorted({key.cell_width for key in keys}, reverse=True)
    colours = style.colours(names)
    figure = Figure(figsize=(5.0, 3.6), layout="constrained")
    axis = figure.subplots()
    room = 0.84 / len(names)
    rng = np.random.default_rng(0)  # spreads the dots
    handles = {}
    for place, name in enumerate(names):
        for group, width in enumerate(widths):
            runs = counts.get(Key(name, category, width))
            if not runs:
                continue
            pixels = np.stack(list(runs.values()))
            values = iou(pixels) if measure == "iou" else pixels[:, 0].astype(float)
            centre = group + (place + 0.5) * room - 0.42
            box = axis.boxplot(
                [values], positions=[centre], widths=0.8 * room, patch_artist=True, showfliers=False,
                medianprops={"color": mpl.rcParams["text.color"]}, boxprops={"alpha": 0.75},
                whiskerprops={"color": colours[name]}, capprops={"color": colours[name]},
                manage_ticks=False,
            )  # fmt: skip
            box["boxes"][0].set(facecolor=colours[name], edgecolor=colours[name])
            handles[name] = box["boxes"][0]
            spread = centre + rng.uniform(-0.25, 0.25, len(values)) * room
            axis.plot(spread, values, ".", color=mpl.rcParams["text.color"], alpha=0.35, markersize=2.5)
    axis.set_xticks(range(len(widths)), [f"{width:g}" for width in widths])
    axis.set_xlabel("cell width, m")
    axis.set_ylabel("IoU of a run" if measure == "iou" else "correct pixels of a run")
    axis.set_ylim(bottom=0)
    axis.set_title(category)
    axis.grid(axis="y")
    _legend_below(figure, [handles[name] for name in handles], [style.label(name) for name in handles])
    return figure


def precision_recall(
    confusion_counts: ConfusionCounts,
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Precision and recall at each threshold at which anything is predicted."""
    predicted = confusion_counts[:, 0] + confusion_counts[:, 1]
    some = predicted > 0
    correct = confusion_counts[some, 0]
    return correct / predicted[some], correct / np.maximum(confusion_counts[some, 2], 1)


def draw_precision_recall(
    tallies: Mapping[str, ConfusionCounts], chosen: Mapping[str, float], title: str
) -> Figure:
    """Precision over recall of each approach, all thresholds; a ring at the one that was chosen."""
    colours = style.colours(list(tallies))
    figure = Figure(figsize=(4.4, 3.9), layout="constrained")
    axis = figure.subplots()
    for name, confusion_counts in tallies.items():
        precision, recall = precision_recall(confusion_counts)
        single = len(np.unique(recall)) == 1
        axis.plot(
            recall,
            precision,
            "o" if single else "-",
            color=colours[name],
            label=style.label(name),
            markersize=5,
        )
        if name in chosen:
            at = round(chosen[name] * 100) - 1
            precision, recall = precision_recall(confusion_counts[at : at + 1])
            axis.plot(recall, precision, "o", color=colours[name], markerfacecolor="none", markersize=9)
    _unit_square(axis, "recall", "precision", title)
    _legend_below(figure, *axis.get_legend_handles_labels())
    return figure


def reliability(
    confusion_counts: ConfusionCounts,
) -> tuple[Float64[np.ndarray, " b"], Float64[np.ndarray, " b"]]:
    """Of each tenth of the scores that holds any cell: the mean score, and the share of its cells that are truth."""
    steps = np.append(
        confusion_counts[:-1, :2] - confusion_counts[1:, :2], confusion_counts[-1:, :2], axis=0
    )  # from each threshold to the next
    scores = (np.arange(len(confusion_counts)) + 1.5) / 100
    found = []
    for low in range(0, len(confusion_counts) + 1, (len(confusion_counts) + 1) // BINS):
        part = slice(max(low - 1, 0), low + (len(confusion_counts) + 1) // BINS - 1)
        cells = steps[part].sum(axis=1)
        if cells.sum():
            found.append((scores[part] @ cells / cells.sum(), steps[part, 0].sum() / cells.sum()))
    means, shares = np.array(found).reshape(-1, 2).T
    return means, shares


def draw_reliability(tallies: Mapping[str, ConfusionCounts], title: str) -> Figure:
    """How often cells with a score are truth: on the diagonal, scores are probabilities.

    Args:
        tallies: by approach, or by kind of cell (`CELLS`) for the network's own probabilities.
        title: of the figure.
    """
    named = all(name in CELLS for name in tallies)
    colours = CELL_COLOURS if named else style.colours(list(tallies))
    figure = Figure(figsize=(4.4, 3.9), layout="constrained")
    axis = figure.subplots()
    axis.plot([0, 1], [0, 1], "--", color=mpl.rcParams["axes.edgecolor"], linewidth=1)
    for name, confusion_counts in tallies.items():
        means, shares = reliability(confusion_counts)
        text = CELLS[name] if named else style.label(name)
        axis.plot(means, shares, "o-", color=colours[name], label=text, markersize=4)
    _unit_square(
        axis, "score" if not named else "predicted probability", "share of cells that are truth", title
    )
    _legend_below(figure, *axis.get_legend_handles_labels())
    return figure


def draw_ablation(panels: Mapping[str, Mapping[str, Sequence[Point]]], across: str, up: str) -> Figure:
    """One panel beside the other, with a line for each name: what came of what was swept, with intervals.

    Args:
        panels: by title, the points of each line.
        across: what was swept.
        up: what came of it.
    """
    figure = Figure(figsize=(0.8 + 3.4 * len(panels), 3.6), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    texts = dict.fromkeys(
        point[0] for lines in panels.values() for points in lines.values() for point in points
    )
    numbers = all(map(_is_number, texts))
    order = sorted(texts, key=float) if numbers else list(texts)
    places = {text: float(text) if numbers else float(at) for at, text in enumerate(order)}
    room = (max(places.values()) - min(places.values()) or 1.0) * 0.012  # keeps intervals apart
    colours = style.colours(names)
    for axis, (title, lines) in zip(axes, panels.items(), strict=True):
        for at, (name, points) in enumerate(lines.items()):
            ranked = sorted(points, key=lambda point: places[point[0]])
            values = np.array([point[1:] for point in ranked])
            shifted = [places[point[0]] + (at - (len(lines) - 1) / 2) * room for point in ranked]
            error = np.maximum(np.stack([values[:, 0] - values[:, 1], values[:, 2] - values[:, 0]]), 0)
            axis.errorbar(
                shifted, values[:, 0], yerr=error, fmt="o-" if numbers else "o", capsize=2, markersize=4,
                color=colours[name], label=style.label(name),
            )  # fmt: skip
        axis.set_xticks(list(places.values()), order, rotation=0 if numbers else 20)
        axis.set_xlabel(across)
        axis.set_title(title)
        axis.grid(axis="y")
    axes[0].set_ylabel(up)
    axes[0].set_ylim(bottom=0)
    _legend_below(figure, *axes[0].get_legend_handles_labels())
    return figure


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _unit_square(axis: Axes, across: str, up: str, title: str) -> None:
    axis.set(xlim=(0, 1.01), ylim=(0, 1.01), xlabel=across, ylabel=up, title=title)
    axis.grid()


def _legend_below(figure: Figure, handles: Sequence[Any], labels: Sequence[str]) -> None:
    """Below the axes, two or three names a row."""
    columns = 3 if len(labels) > 4 else 2
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)
