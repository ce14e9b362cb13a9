"""Figures of global maps: ground truth, agreement, viewpoints."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from imagination.evaluation.metrics import count, iou
from imagination.evaluation.records import Example
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.single_views import ranked_by
from imagination.evaluation.threshold_selection import THRESHOLDS
from imagination.geometry.grid import Grid
from imagination.reporting import style
from imagination.utils.atomic_io import replacing

CORRECT, FALSE, MISSED = (0, 114, 178), (213, 94, 0), (240, 200, 60)
EMPTY, OCCUPIED, GROUND_TRUTH = (255, 255, 255), (208, 208, 208), (50, 50, 60)
"""Colours of cells in maps, RGB; blue, vermilion and yellow are colour-blind safe."""

BAR = 2.0
"""Length of the scale bar under maps, metres."""

INCH, DPI = 3.2, 110
"""Side of one map in a figure in inches, and resolution in pixels per inch."""


def gt_image(example: Example) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image of the ground truth over the occupied cells."""
    image = _background(example)
    image[example.truth] = GROUND_TRUTH
    return image


def agreement_image(example: Example, predicted: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image of correct, false and missed cells of a predicted map over the occupied cells."""
    image = _background(example)
    image[predicted & example.truth] = CORRECT
    image[predicted & ~example.truth] = FALSE
    image[~predicted & example.truth] = MISSED
    return image


def draw_maps(examples: Sequence[Example]) -> Figure:
    """Draw one row for each example: ground truth with viewpoints, then the map of each approach with its IoU."""
    names = list(examples[0].predicted)
    windows = [_window(example) for example in examples]
    ratios = [(rows.stop - rows.start) / (columns.stop - columns.start) for rows, columns in windows]
    heights = [min(max(INCH * ratio, 0.4 * INCH), 2 * INCH) + 0.55 for ratio in ratios]
    figure = Figure(figsize=(INCH * (1 + len(names)), sum(heights) + 0.4), layout="constrained")
    axes = figure.subplots(len(examples), 1 + len(names), squeeze=False, height_ratios=heights)
    for row, example, window in zip(axes, examples, windows, strict=True):
        row[0].imshow(gt_image(example)[window])
        row[0].set_title("Ground truth and viewpoints")
        row[0].set_ylabel(
            f"{example.category}, {example.trial.scene}\ncell width {example.trial.cell_width:g} m"
        )
        draw_poses(row[0], example.poses, example.grid, window)
        draw_scale_bar(row[0], example.grid.resolution)
        for axis, (name, predicted) in zip(row[1:], example.predicted.items(), strict=True):
            axis.imshow(agreement_image(example, predicted)[window])
            axis.set_title(style.label(name))
            axis.set_xlabel(f"IoU {float(iou(count(predicted, example.truth))):.3f}")
        for axis in row:
            bare(axis)
    colours = {"correct": CORRECT, "false": FALSE, "missed": MISSED}
    draw_legend(figure, {**colours, "ground truth": GROUND_TRUTH, "occupied": OCCUPIED})
    return figure


def draw_poses(
    axis: Axes, poses: Float64[np.ndarray, "n 3"], grid: Grid, window: tuple[slice, slice]
) -> None:
    """Draw an arrow of half a metre at each pose, in the direction of its heading."""
    cells = grid.to_cells(poses[:, :2]) - [window[0].start, window[1].start]
    length = 0.5 / grid.resolution
    axis.quiver(
        cells[:, 1], cells[:, 0], length * np.cos(poses[:, 2]), -length * np.sin(poses[:, 2]),
        color="#cc3377", angles="xy", scale_units="xy", scale=1, width=0.006, headwidth=4, headlength=4,
    )  # fmt: skip
    axis.plot(cells[:, 1], cells[:, 0], "o", color="#cc3377", markersize=2.5)


def draw_scale_bar(axis: Axes, resolution: float) -> None:
    """Draw a bar of `BAR` metres below a map's lower left corner."""
    transform = axis.get_xaxis_transform()  # x in cells, y as fraction of the map's height
    colour = mpl.rcParams["text.color"]
    axis.plot(
        [0, BAR / resolution], [-0.03, -0.03], transform=transform, color=colour, clip_on=False, linewidth=2
    )
    axis.text(0, -0.045, f"{BAR:g} m", transform=transform, ha="left", va="top", fontsize=8)


def bare(axis: Axes) -> None:
    """Remove the ticks of an axis and show its frame."""
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(True)


def draw_legend(figure: Figure, colours: Mapping[str, tuple[int, int, int]]) -> None:
    """Draw the legend of cell colours below the figure."""
    patches = [
        Patch(facecolor=f"#{bytes(colour).hex()}", edgecolor="#8a94a3", label=name)
        for name, colour in colours.items()
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches))


def save(figure: Figure, path: Path) -> None:
    """Write a figure as .png or .pdf, according to the suffix of the path; equal figures give equal bytes."""
    FigureCanvasAgg(figure)
    kind = path.suffix.removeprefix(".")
    metadata = {"png": {"Software": None}, "pdf": {"CreationDate": None, "Producer": None, "Creator": None}}
    with replacing(path) as temporary:
        figure.savefig(temporary, format=kind, dpi=DPI, metadata=metadata[kind])


def _background(example: Example) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image of the occupied cells."""
    image = np.full((*example.truth.shape, 3), EMPTY, np.uint8)
    image[example.occupied] = OCCUPIED
    return image


def _window(example: Example) -> tuple[slice, slice]:
    return scene_window(example.occupied, example.grid, example.poses)


def scene_window(
    occupied: Bool[np.ndarray, "h w"], grid: Grid, poses: Float64[np.ndarray, "n 3"]
) -> tuple[slice, slice]:
    """Return the rows and columns of a scene: its occupied cells and its viewpoints with a margin."""
    cells = np.concatenate([np.argwhere(occupied), grid.to_cells(poses[:, :2])])
    if not len(cells):
        return slice(0, grid.rows), slice(0, grid.columns)
    low = np.maximum(cells.min(axis=0) - 3, 0).tolist()
    high = np.minimum(cells.max(axis=0) + 4, grid.shape).tolist()
    return slice(low[0], high[0]), slice(low[1], high[1])


def typical(maps: Sequence[SavedMaps], category: str, cell_width: float) -> SavedMaps | None:
    """Return the trial with the median IoU of the ranking approach at a cell width; None without trials."""
    ranked = []
    for saved in maps:
        if saved.trial.cell_width == cell_width and category in saved.categories:
            layer = saved.categories.index(category)
            if saved.present[layer]:
                place = saved.approaches.index(ranked_by(saved.approaches))
                pixels = count(saved.predicted[place, layer], saved.truth[layer])
                ranked.append((float(iou(pixels)), saved.trial, saved))
    ranked.sort(key=lambda entry: entry[:2])
    return ranked[len(ranked) // 2][2] if ranked else None


def draw_typical(maps: Sequence[SavedMaps], category: str, cell_widths: Sequence[float]) -> Figure:
    """Draw the trial with the median IoU for each cell width."""
    trials = [saved for width in cell_widths if (saved := typical(maps, category, width)) is not None]
    return draw_maps([saved.example(saved.categories.index(category)) for saved in trials])


def draw_viewpoints(maps: Sequence[SavedMaps]) -> Figure:
    """Draw two viewpoint sets of the widest and one of the narrowest cell width, in the scene with most views."""
    scene = max(maps, key=lambda saved: len(saved.poses)).trial.scene
    by_width: dict[float, list[SavedMaps]] = {}
    of_scene = [saved for saved in maps if saved.trial.scene == scene]
    for saved in sorted(of_scene, key=lambda saved: saved.trial.number):
        by_width.setdefault(saved.trial.cell_width, []).append(saved)
    shown = by_width[max(by_width)][:2] + (by_width[min(by_width)][:1] if len(by_width) > 1 else [])
    figure = Figure(figsize=(3.2 * len(shown), 3.4), layout="constrained")
    axes = figure.subplots(1, len(shown), squeeze=False)[0]
    for axis, saved in zip(axes, shown, strict=True):
        image = np.full((*saved.occupied.shape, 3), EMPTY, np.uint8)
        image[saved.occupied] = OCCUPIED
        window = scene_window(saved.occupied, saved.grid, saved.poses)
        axis.imshow(image[window])
        draw_poses(axis, saved.poses, saved.grid, window)
        draw_scale_bar(axis, saved.grid.resolution)
        points = len(np.unique(saved.poses[:, :2], axis=0))
        axis.set_title(
            f"{scene}, cell width {saved.trial.cell_width:g} m, set {saved.trial.number}\n"
            f"viewpoints: {points}, views: {len(saved.poses)}"
        )
        bare(axis)
    draw_legend(figure, {"occupied": OCCUPIED})
    return figure


def counts_by_threshold(maps: Sequence[SavedMaps]) -> dict[tuple[str, str], Int64[np.ndarray, "t 3"]]:
    """Count correct, false-positive and ground-truth pixels at the thresholds .01 to .99, over all trials.

    The counts are by approach and category.
    """
    totals: dict[tuple[str, str], Int64[np.ndarray, "t 3"]] = {}
    for saved in maps:
        for layer, category in enumerate(saved.categories):
            if not saved.present[layer]:
                continue
            gt = saved.truth[layer]
            for place, approach in enumerate(saved.approaches):
                level = saved.level[place, layer]
                histograms = [
                    np.bincount(level[cells], minlength=len(THRESHOLDS) + 1)[1:] for cells in (gt, ~gt)
                ]
                correct, false = (histogram[::-1].cumsum()[::-1] for histogram in histograms)
                gt_pixels = np.full(len(THRESHOLDS), np.count_nonzero(gt))
                counts = np.stack([correct, false, gt_pixels], axis=-1)
                totals[approach, category] = totals.get((approach, category), 0) + counts
    return totals
