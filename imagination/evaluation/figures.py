"""Figures of the mapping task: global maps beside the truth, and IoU by approach and cell width."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from imagination.evaluation.outcome import Example, Report
from imagination.evaluation.tables import Row
from imagination.runs import replacing

CORRECT, FALSE, MISSED = (46, 139, 87), (214, 69, 65), (240, 173, 78)
EMPTY, OCCUPIED, TRUTH = (255, 255, 255), (205, 205, 205), (70, 90, 160)
"""Colours of cells in maps, RGB."""

INCH, DPI = 3.2, 110
"""Side of one map in a figure, and pixels an inch."""


def truth_image(example: Example) -> UInt8[np.ndarray, "h w 3"]:
    """The truth, over everything occupied."""
    image = _background(example)
    image[example.truth] = TRUTH
    return image


def agreement_image(example: Example, predicted: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """A predicted map against the truth: correct, false and missed cells, over everything occupied."""
    image = _background(example)
    image[predicted & example.truth] = CORRECT
    image[predicted & ~example.truth] = FALSE
    image[~predicted & example.truth] = MISSED
    return image


def side_by_side(example: Example) -> UInt8[np.ndarray, "h w 3"]:
    """Truth and the map of each approach in one image, for TensorBoard."""
    window = _home_window(example)
    images = [truth_image(example), *(agreement_image(example, map_) for map_ in example.predicted.values())]
    framed = [np.pad(image[window], ((2, 2), (2, 2), (0, 0)), constant_values=120) for image in images]
    return np.concatenate(framed, axis=1)


def draw_maps(examples: Sequence[Example]) -> Figure:
    """One row for each example: the truth with the viewpoints, then the map of each approach."""
    names = list(examples[0].predicted)
    figure = Figure(figsize=(INCH * (1 + len(names)), INCH * len(examples) + 0.5), layout="constrained")
    axes = figure.subplots(len(examples), 1 + len(names), squeeze=False)
    for row, example in zip(axes, examples, strict=True):
        window = _home_window(example)
        row[0].imshow(truth_image(example)[window])
        row[0].set_title("truth and viewpoints", fontsize=9)
        row[0].set_ylabel(f"{example.category}, {example.run.home}, {example.run.cell_width:g} m", fontsize=9)
        cells = example.grid.to_cells(example.poses[:, :2]) - [window[0].start, window[1].start]
        row[0].quiver(
            cells[:, 1], cells[:, 0], np.cos(example.poses[:, 2]), np.sin(example.poses[:, 2]),
            color="black", scale=14, width=0.008,
        )  # fmt: skip
        for axis, (name, predicted) in zip(row[1:], example.predicted.items(), strict=True):
            axis.imshow(agreement_image(example, predicted)[window])
            axis.set_title(name, fontsize=9)
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    colours = {"correct": CORRECT, "false": FALSE, "missed": MISSED, "truth": TRUTH, "occupied": OCCUPIED}
    patches = [Patch(color=f"#{bytes(colour).hex()}", label=name) for name, colour in colours.items()]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), fontsize=9)
    return figure


def draw_iou(rows: Sequence[Row]) -> Figure:
    """Pooled IoU of each approach by cell width, with its interval, one panel for each category."""
    categories = list(dict.fromkeys(row["category"] for row in rows))
    names = list(dict.fromkeys(row["approach"] for row in rows))
    widths = sorted({float(row["cell_width"]) for row in rows}, reverse=True)
    figure = Figure(figsize=(1 + 4 * len(categories), 3.4), layout="constrained")
    axes = figure.subplots(1, len(categories), squeeze=False, sharey=True)[0]
    bar = 0.8 / len(names)
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
                label=name,
            )
        axis.set_xticks(range(len(widths)), [f"{width:g}" for width in widths])
        axis.set_xlabel("cell width, m")
        axis.set_title(category)
    axes[0].set_ylabel("pooled IoU")
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=1 + len(categories),
        fontsize=9,
    )
    return figure


def write(folder: Path, report: Report, rows: Sequence[Row]) -> None:
    """Write maps_<category>.png and iou.png into `folder`, each whole or not at all."""
    by_category: dict[str, list[Example]] = defaultdict(list)
    for example in report.examples:
        by_category[example.category].append(example)
    for category, examples in by_category.items():
        save(draw_maps(examples), folder / f"maps_{category}.png")
    save(draw_iou(rows), folder / "iou.png")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; the same figure gives the same bytes."""
    FigureCanvasAgg(figure)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI, metadata={"Software": None})


def _background(example: Example) -> UInt8[np.ndarray, "h w 3"]:
    image = np.full((*example.truth.shape, 3), EMPTY, np.uint8)
    image[example.occupied] = OCCUPIED
    return image


def _home_window(example: Example) -> tuple[slice, slice]:
    """The cells of the home itself: what is occupied in it, and its viewpoints."""
    cells = np.concatenate([np.argwhere(example.occupied), example.grid.to_cells(example.poses[:, :2])])
    low = np.maximum(cells.min(axis=0) - 3, 0).tolist()
    high = np.minimum(cells.max(axis=0) + 4, example.truth.shape).tolist()
    return slice(low[0], high[0]), slice(low[1], high[1])
