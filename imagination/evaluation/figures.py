"""Figures of the mapping task: global maps beside the truth, and IoU by approach and cell width."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from imagination.evaluation import style
from imagination.evaluation.metrics import count, iou
from imagination.evaluation.outcome import Example, Report
from imagination.evaluation.tables import Row
from imagination.geometry.grid import Grid
from imagination.runs import replacing

CORRECT, FALSE, MISSED = (0, 114, 178), (213, 94, 0), (240, 200, 60)
EMPTY, OCCUPIED, TRUTH = (255, 255, 255), (208, 208, 208), (50, 50, 60)
"""Colours of cells in maps, RGB: blue, vermilion and yellow differ for people who see few colours, too."""

BAR = 2.0
"""Length of the scale bar under maps, metres."""

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
    """One row for each example: the truth with the viewpoints, then the map of each approach with its IoU."""
    names = list(examples[0].predicted)
    windows = [_home_window(example) for example in examples]
    ratios = [(rows.stop - rows.start) / (columns.stop - columns.start) for rows, columns in windows]
    heights = [min(max(INCH * ratio, 0.4 * INCH), 2 * INCH) + 0.55 for ratio in ratios]
    figure = Figure(figsize=(INCH * (1 + len(names)), sum(heights) + 0.4), layout="constrained")
    axes = figure.subplots(len(examples), 1 + len(names), squeeze=False, height_ratios=heights)
    for row, example, window in zip(axes, examples, windows, strict=True):
        row[0].imshow(truth_image(example)[window])
        row[0].set_title("Truth and viewpoints")
        row[0].set_ylabel(f"{example.category}, {example.run.home}\ncell width {example.run.cell_width:g} m")
        draw_poses(row[0], example.poses, example.grid, window)
        draw_scale_bar(row[0], example.grid.resolution)
        for axis, (name, predicted) in zip(row[1:], example.predicted.items(), strict=True):
            axis.imshow(agreement_image(example, predicted)[window])
            axis.set_title(style.label(name))
            axis.set_xlabel(f"IoU {float(iou(count(predicted, example.truth))):.3f}")
        for axis in row:
            bare(axis)
    colours = {"correct": CORRECT, "false": FALSE, "missed": MISSED, "truth": TRUTH, "occupied": OCCUPIED}
    draw_legend(figure, colours)
    return figure


def draw_poses(
    axis: Axes, poses: Float64[np.ndarray, "n 3"], grid: Grid, window: tuple[slice, slice]
) -> None:
    """Arrows where the robot stood, the way it looked; half a metre long."""
    cells = grid.to_cells(poses[:, :2]) - [window[0].start, window[1].start]
    reach = 0.5 / grid.resolution
    axis.quiver(
        cells[:, 1], cells[:, 0], reach * np.cos(poses[:, 2]), -reach * np.sin(poses[:, 2]),
        color="#cc3377", angles="xy", scale_units="xy", scale=1, width=0.006, headwidth=4, headlength=4,
    )  # fmt: skip
    axis.plot(cells[:, 1], cells[:, 0], "o", color="#cc3377", markersize=2.5)


def draw_scale_bar(axis: Axes, resolution: float) -> None:
    """A bar of `BAR` metres under a map's lower left corner."""
    across = axis.get_xaxis_transform()  # x in cells, y in heights of the map
    colour = mpl.rcParams["text.color"]
    axis.plot(
        [0, BAR / resolution], [-0.03, -0.03], transform=across, color=colour, clip_on=False, linewidth=2
    )
    axis.text(0, -0.045, f"{BAR:g} m", transform=across, ha="left", va="top", fontsize=8)


def bare(axis: Axes) -> None:
    """An axis around a picture: no ticks, a rim."""
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(True)


def draw_legend(figure: Figure, colours: Mapping[str, tuple[int, int, int]]) -> None:
    """What the colours of cells mean, below everything."""
    patches = [
        Patch(facecolor=f"#{bytes(colour).hex()}", edgecolor="#8a94a3", label=name)
        for name, colour in colours.items()
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches))


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


def write(folder: Path, report: Report, rows: Sequence[Row]) -> None:
    """Write maps_<category>.png and iou.png into `folder`, each whole or not at all."""
    by_category: dict[str, list[Example]] = defaultdict(list)
    for example in report.examples:
        by_category[example.category].append(example)
    with style.theme("light"):
        for category, examples in by_category.items():
            save(draw_maps(examples), folder / f"maps_{category}.png")
        save(draw_iou(rows), folder / "iou.png")


def save(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the path's ending, .png or .pdf; the same figure gives the same bytes."""
    FigureCanvasAgg(figure)
    kind = path.suffix.removeprefix(".")
    dated = {"png": {"Software": None}, "pdf": {"CreationDate": None, "Producer": None, "Creator": None}}
    with replacing(path) as temporary:
        figure.savefig(temporary, format=kind, dpi=DPI, metadata=dated[kind])


def _background(example: Example) -> UInt8[np.ndarray, "h w 3"]:
    image = np.full((*example.truth.shape, 3), EMPTY, np.uint8)
    image[example.occupied] = OCCUPIED
    return image


def _home_window(example: Example) -> tuple[slice, slice]:
    return home_window(example.occupied, example.grid, example.poses)


def home_window(
    occupied: Bool[np.ndarray, "h w"], grid: Grid, poses: Float64[np.ndarray, "n 3"]
) -> tuple[slice, slice]:
    """The cells of the home itself: what is occupied in it, and its viewpoints."""
    cells = np.concatenate([np.argwhere(occupied), grid.to_cells(poses[:, :2])])
    if not len(cells):
        return slice(0, grid.rows), slice(0, grid.columns)
    low = np.maximum(cells.min(axis=0) - 3, 0).tolist()
    high = np.minimum(cells.max(axis=0) + 4, grid.shape).tolist()
    return slice(low[0], high[0]), slice(low[1], high[1])
