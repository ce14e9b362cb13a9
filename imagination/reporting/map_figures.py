"""Whole maps side by side, sparse viewpoints on a map, and what saved maps tell at every threshold."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64
from matplotlib.figure import Figure

from imagination.evaluation.figures import (
    EMPTY,
    OCCUPIED,
    bare,
    draw_legend,
    draw_maps,
    draw_poses,
    draw_scale_bar,
    home_window,
)
from imagination.evaluation.map_files import SavedMaps
from imagination.evaluation.metrics import count, iou
from imagination.evaluation.selection import THRESHOLDS
from imagination.evaluation.single_views import ranked_by


def typical(maps: Sequence[SavedMaps], category: str, cell_width: float) -> SavedMaps | None:
    """Of the runs with a cell width, the one of median IoU by the ranking approach; None without one."""
    ranked = []
    for saved in maps:
        if saved.run.cell_width == cell_width and category in saved.categories:
            layer = saved.categories.index(category)
            if saved.present[layer]:
                place = saved.approaches.index(ranked_by(saved.approaches))
                pixels = count(saved.predicted[place, layer], saved.truth[layer])
                ranked.append((float(iou(pixels)), saved.run, saved))
    ranked.sort(key=lambda entry: entry[:2])
    return ranked[len(ranked) // 2][2] if ranked else None


def draw_typical(maps: Sequence[SavedMaps], category: str, cell_widths: Sequence[float]) -> Figure:
    """For each cell width the run with the median IoU: the truth, then the map of each approach."""
    chosen = [found for width in cell_widths if (found := typical(maps, category, width)) is not None]
    return draw_maps([saved.example(saved.categories.index(category)) for saved in chosen])


def draw_viewpoints(maps: Sequence[SavedMaps]) -> Figure:
    """Two viewpoint sets of the widest cell width and one of the narrowest, on the map of the home with most."""
    home = max(maps, key=lambda saved: len(saved.poses)).run.home
    by_width: dict[float, list[SavedMaps]] = {}
    for saved in sorted((one for one in maps if one.run.home == home), key=lambda one: one.run.number):
        by_width.setdefault(saved.run.cell_width, []).append(saved)
    shown = by_width[max(by_width)][:2] + (by_width[min(by_width)][:1] if len(by_width) > 1 else [])
    figure = Figure(figsize=(3.2 * len(shown), 3.4), layout="constrained")
    axes = figure.subplots(1, len(shown), squeeze=False)[0]
    for axis, saved in zip(axes, shown, strict=True):
        image = np.full((*saved.occupied.shape, 3), EMPTY, np.uint8)
        image[saved.occupied] = OCCUPIED
        window = home_window(saved.occupied, saved.grid, saved.poses)
        axis.imshow(image[window])
        draw_poses(axis, saved.poses, saved.grid, window)
        draw_scale_bar(axis, saved.grid.resolution)
        points = len(np.unique(saved.poses[:, :2], axis=0))
        axis.set_title(
            f"{home}, cell width {saved.run.cell_width:g} m, set {saved.run.number}\n"
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
