"""Figures of single views: the best, the median and the worst view with the map of each approach."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, UInt8
from matplotlib.figure import Figure

from imagination.evaluation.metrics import count, iou
from imagination.evaluation.single_views import SingleView
from imagination.reporting import style
from imagination.reporting.figures.maps import (
    CORRECT,
    FALSE,
    GROUND_TRUTH,
    MISSED,
    OCCUPIED,
    bare,
    draw_legend,
    draw_scale_bar,
)

SEEN, UNSEEN = (255, 255, 255), (234, 236, 240)
"""Colours of cells that depth saw and did not see, RGB."""


def draw_single_views(views: Sequence[SingleView], resolution: float) -> Figure:
    """Draw a row for each view: image, V_label over V_seen, probabilities, map of each approach with its IoU."""
    names = list(views[0].predicted)
    has_unit = bool(np.isfinite(views[0].probabilities).all())
    heads = ["Image", "Label", *(["Probability"] if has_unit else []), *map(style.label, names)]
    columns = len(heads)
    figure = Figure(figsize=(2.3 * columns, 2.6 * len(views) + 0.8), layout="constrained")
    axes = figure.subplots(len(views), columns, squeeze=False)
    for axis, title in zip(axes[0], heads, strict=True):
        axis.set_title(title)
    for row, view in zip(axes, views, strict=True):
        row[0].imshow(view.rgb)
        row[0].set_ylabel(f"{view.rank}: {view.category}, {view.scene}")
        label = _background(view)
        label[view.label] = GROUND_TRUTH
        row[1].imshow(label)
        draw_scale_bar(row[1], resolution)
        if has_unit:
            shown = row[2].imshow(view.probabilities, cmap="cividis", vmin=0, vmax=1)
        for axis, predicted in zip(row[-len(names) :], view.predicted.values(), strict=True):
            axis.imshow(_agreement(view, predicted))
            axis.set_xlabel(f"IoU {float(iou(count(predicted, view.label))):.3f}")
        for axis in row:
            bare(axis)
        for axis in row[1:]:
            axis.plot(view.label.shape[1] // 2, view.label.shape[0] - 1, "^", color="#cc3377", markersize=6)
    if has_unit:
        scale = axes[-1, 2].inset_axes((0.1, -0.12, 0.8, 0.05))  # an inset keeps the size of the panel
        figure.colorbar(shown, cax=scale, orientation="horizontal", ticks=[0, 0.5, 1])
    colours = {
        "label": GROUND_TRUTH, "correct": CORRECT, "false": FALSE, "missed": MISSED,
        "occupied": OCCUPIED, "seen": SEEN, "not seen": UNSEEN,
    }  # fmt: skip
    draw_legend(figure, colours)
    return figure


def _background(view: SingleView) -> UInt8[np.ndarray, "v v 3"]:
    """Return an image of seen and occupied cells."""
    image = np.full((*view.label.shape, 3), UNSEEN, np.uint8)
    image[view.seen] = SEEN
    image[view.occupied] = OCCUPIED
    return image


def _agreement(view: SingleView, predicted: Bool[np.ndarray, "v v"]) -> UInt8[np.ndarray, "v v 3"]:
    """Return an image of correct, false and missed cells over the background."""
    image = _background(view)
    image[predicted & view.label] = CORRECT
    image[predicted & ~view.label] = FALSE
    image[~predicted & view.label] = MISSED
    return image
