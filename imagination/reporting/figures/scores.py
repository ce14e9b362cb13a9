"""Figures of scores: IoU bars, distributions, precision over recall, reliability, ablations."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imagination.evaluation.metrics import iou
from imagination.evaluation.read_records import ConfusionCounts
from imagination.evaluation.record_files import PIXELS
from imagination.reporting import style
from imagination.reporting.statistics import Estimate, select
from imagination.utils.tabular import Row, is_number


def draw_iou(rows: Sequence[Row]) -> Figure:
    """Draw the pooled IoU of each approach by cell width with its interval, one panel for each category."""
    categories = list(dict.fromkeys(row["category"] for row in rows))
    names = list(dict.fromkeys(row["approach"] for row in rows))
    widths = sorted({float(row["cell_width"]) for row in rows}, reverse=True)
    figure = Figure(figsize=(1 + 4 * len(categories), 3.4), layout="constrained")
    axes = figure.subplots(1, len(categories), squeeze=False, sharey=True)[0]
    bar, colours = 0.8 / len(names), style.colours(names)
    for axis, category in zip(axes, categories, strict=True):
        for place, name in enumerate(names):
            by_width = {
                float(row["cell_width"]): row
                for row in rows
                if (row["category"], row["approach"]) == (category, name)
            }
            value, low, high = (
                np.array([float(by_width[width][column] or "nan") for width in widths])
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
"""Number of bins of predicted probabilities in a figure of reliability."""

CELLS = {"all": "all cells", "seen": "cells that depth saw", "unseen": "other cells"}
"""Labels of subsets of cells."""

CELL_COLOURS = {"all": "#777777", "seen": "#0072b2", "unseen": "#d55e00"}
"""Colours of subsets of cells."""

Point = tuple[str, Estimate]
"""Swept value as text, and the metric."""


def draw_distribution(trials: pd.DataFrame, category: str, measure: str) -> Figure:
    """Draw a box for each approach and cell width of the trials' IoU or correct pixels, with every trial as a dot.

    Boxes span the quartiles; whiskers extend to the last trial within 1.5 times the interquartile range.
    """
    trials = trials[trials["category"] == category]
    names = list(trials["approach"].unique())
    widths = sorted(trials["cell_width"].unique().tolist(), reverse=True)
    colours = style.colours(names)
    figure = Figure(figsize=(5.0, 3.6), layout="constrained")
    axis = figure.subplots()
    room = 0.84 / len(names)
    rng = np.random.default_rng(0)  # spreads the dots
    handles = {}
    for place, name in enumerate(names):
        for group, width in enumerate(widths):
            pixels = select(trials, name, category, width)[list(PIXELS)].to_numpy()
            if not len(pixels):
                continue
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
    axis.set_ylabel("IoU of a trial" if measure == "iou" else "correct pixels of a trial")
    axis.set_ylim(bottom=0)
    axis.set_title(category)
    axis.grid(axis="y")
    legend_below(figure, [handles[name] for name in handles], [style.label(name) for name in handles])
    return figure


def precision_recall(
    counts: ConfusionCounts,
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Return precision and recall at each threshold with predicted cells."""
    predicted = counts[:, 0] + counts[:, 1]
    valid = predicted > 0
    correct = counts[valid, 0]
    return correct / predicted[valid], correct / np.maximum(counts[valid, 2], 1)


def draw_precision_recall(
    lines: Mapping[str, ConfusionCounts], selected: Mapping[str, float], title: str
) -> Figure:
    """Draw precision over recall of each approach at all thresholds, with a ring at the selected threshold.

    Args:
        lines: counts by approach.
        selected: selected threshold by approach.
        title: title of the figure.
    """
    colours = style.colours(list(lines))
    figure = Figure(figsize=(4.4, 3.9), layout="constrained")
    axis = figure.subplots()
    for name, counts in lines.items():
        precision, recall = precision_recall(counts)
        single = len(np.unique(recall)) == 1
        axis.plot(
            recall,
            precision,
            "o" if single else "-",
            color=colours[name],
            label=style.label(name),
            markersize=5,
        )
        if name in selected:
            index = round(selected[name] * 100) - 1
            precision, recall = precision_recall(counts[index : index + 1])
            axis.plot(recall, precision, "o", color=colours[name], markerfacecolor="none", markersize=9)
    _unit_square(axis, "recall", "precision", title)
    legend_below(figure, *axis.get_legend_handles_labels())
    return figure


def reliability(
    counts: ConfusionCounts,
) -> tuple[Float64[np.ndarray, " b"], Float64[np.ndarray, " b"]]:
    """Return the mean score and the fraction of ground-truth cells in each of `BINS` bins of scores with cells."""
    # cells whose score is between each threshold and the next
    histogram = np.append(counts[:-1, :2] - counts[1:, :2], counts[-1:, :2], axis=0)
    scores = (np.arange(len(counts)) + 1.5) / 100
    width = (len(counts) + 1) // BINS
    points = []
    for low in range(0, len(counts) + 1, width):
        part = slice(max(low - 1, 0), low + width - 1)
        cells = histogram[part].sum(axis=1)
        if cells.sum():
            points.append((scores[part] @ cells / cells.sum(), histogram[part, 0].sum() / cells.sum()))
    means, fractions = np.array(points).reshape(-1, 2).T
    return means, fractions


def draw_reliability(lines: Mapping[str, ConfusionCounts], title: str) -> Figure:
    """Draw the fraction of ground-truth cells over the score; calibrated scores are on the diagonal.

    Args:
        lines: counts by approach, or by subset of cells (`CELLS`) for the network's probabilities.
        title: title of the figure.
    """
    by_cells = all(name in CELLS for name in lines)
    colours = CELL_COLOURS if by_cells else style.colours(list(lines))
    figure = Figure(figsize=(4.4, 3.9), layout="constrained")
    axis = figure.subplots()
    axis.plot([0, 1], [0, 1], "--", color=mpl.rcParams["axes.edgecolor"], linewidth=1)
    for name, counts in lines.items():
        means, fractions = reliability(counts)
        label = CELLS[name] if by_cells else style.label(name)
        axis.plot(means, fractions, "o-", color=colours[name], label=label, markersize=4)
    xlabel = "predicted probability" if by_cells else "score"
    _unit_square(axis, xlabel, "fraction of ground-truth cells", title)
    legend_below(figure, *axis.get_legend_handles_labels())
    return figure


def draw_ablation(panels: Mapping[str, Mapping[str, Sequence[Point]]], xlabel: str, ylabel: str) -> Figure:
    """Draw a metric over the swept value with intervals, one panel for each title and a line for each name.

    Args:
        panels: points of each line, by title of the panel and name of the line.
        xlabel: name of the swept key.
        ylabel: name of the metric.
    """
    figure = Figure(figsize=(0.8 + 3.4 * len(panels), 3.6), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    values = dict.fromkeys(
        point[0] for lines in panels.values() for points in lines.values() for point in points
    )
    numeric = all(map(is_number, values))
    order = sorted(values, key=float) if numeric else list(values)
    positions = {value: float(value) if numeric else float(index) for index, value in enumerate(order)}
    offset = (max(positions.values()) - min(positions.values()) or 1.0) * 0.012  # separates intervals
    colours = style.colours(names)
    for axis, (title, lines) in zip(axes, panels.items(), strict=True):
        for index, (name, points) in enumerate(lines.items()):
            ordered = sorted(points, key=lambda point: positions[point[0]])
            metric, low, high, _ = np.array([point[1] for point in ordered]).T
            x = [positions[point[0]] + (index - (len(lines) - 1) / 2) * offset for point in ordered]
            error = np.maximum(np.stack([metric - low, high - metric]), 0)
            axis.errorbar(
                x, metric, yerr=error, fmt="o-" if numeric else "o", capsize=2, markersize=4,
                color=colours[name], label=style.label(name),
            )  # fmt: skip
        axis.set_xticks(list(positions.values()), order, rotation=0 if numeric else 20)
        axis.set_xlabel(xlabel)
        axis.set_title(title)
        axis.grid(axis="y")
    axes[0].set_ylabel(ylabel)
    axes[0].set_ylim(bottom=0)
    legend_below(figure, *axes[0].get_legend_handles_labels())
    return figure


def _unit_square(axis: Axes, xlabel: str, ylabel: str, title: str) -> None:
    axis.set(xlim=(0, 1.01), ylim=(0, 1.01), xlabel=xlabel, ylabel=ylabel, title=title)
    axis.grid()


def legend_below(figure: Figure, handles: Sequence[Any], labels: Sequence[str]) -> None:
    """Draw the legend below the axes, two or three names per row."""
    columns = 3 if len(labels) > 4 else 2
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)
