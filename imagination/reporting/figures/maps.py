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
EMPTY, OCCUPIED, TRUTH = (255, 255, 255), (208, 208, 208), (50, 50, 60)
"""Colours of cells in maps, RGB: blue, vermilion and yellow differ for people who see few colours, too."""

BAR = 2.0
"""Length of the scale bar under maps, metres."""

INCH, DPI = 3.2, 110
"""Side of one map in a figure, and pixels an inch."""


def gt_image(example: Example) -> UInt8[np.ndarray, "h w 3"]:
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
    images = [gt_image(example), *(agreement_image(example, map_) for map_ in example.predicted.values())]
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
        row[0].imshow(gt_image(example)[window])
        row[0].set_title("Truth and viewpoints")
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
    return scene_window(example.occupied, example.grid, example.poses)


def scene_window(
    occupied: Bool[np.ndarray, "h w"], grid: Grid, poses: Float64[np.ndarray, "n 3"]
) -> tuple[slice, slice]:
    """The cells of the scene itself: what is occupied in it, and its viewpoints."""
    cells = np.concatenate([np.argwhere(occupied), grid.to_cells(poses[:, :2])])
    if not len(cells):
        return slice(0, grid.rows), slice(0, grid.columns)
    low = np.maximum(cells.min(axis=0) - 3, 0).tolist()
    high = np.minimum(cells.max(axis=0) + 4, grid.shape).tolist()
    return slice(low[0], high[0]), slice(low[1], high[1])


def typical(maps: Sequence[SavedMaps], category: str, cell_width: float) -> SavedMaps | None:
    """Of the runs with a cell width, the one of median IoU by the ranking approach; None without one."""
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
    """For each cell width the run with the median IoU: the truth, then the map of each approach."""
    chosen = [found for width in cell_widths if (found := typical(maps, category, width)) is not None]
    return draw_maps([saved.example(saved.categories.index(category)) for saved in chosen])


def draw_viewpoints(maps: Sequence[SavedMaps]) -> Figure:
    """Two viewpoint sets of the widest cell width and one of the narrowest, on the map of the scene with most."""
    scene = max(maps, key=lambda saved: len(saved.poses)).trial.scene
    by_width: dict[float, list[SavedMaps]] = {}
    for saved in sorted((one for one in maps if one.trial.scene == scene), key=lambda one: one.trial.number):
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


def tallies(maps: Sequence[SavedMaps]) -> dict[tuple[str, str], Int64[np.ndarray, "t 3"]]:
    """Correct, false and truth pixels of each approach and category at thresholds .01 to .99, over all runs."""
    found: dict[tuple[str, str], Int64[np.ndarray, "t 3"]] = {}
    for saved in maps:
        for layer, category in enumerate(saved.categories):
            if not saved.present[layer]:
                continue
            truth = saved.truth[layer]
            for place, approach in enumerate(saved.approaches):
                level = saved.level[place, layer]
                counts = [
                    np.bincount(level[cells], minlength=len(THRESHOLDS) + 1)[1:] for cells in (truth, ~truth)
                ]
                correct, false = (values[::-1].cumsum()[::-1] for values in counts)
                total = np.full(len(THRESHOLDS), np.count_nonzero(truth))
                zero = np.zeros((len(THRESHOLDS), 3), np.int64)
                found[approach, category] = found.get((approach, category), zero) + np.stack(
                    [correct, false, total], axis=-1
                )
    return found
