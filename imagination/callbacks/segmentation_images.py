"""Images of first-person segmentation."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from imagination.callbacks.view_images import ViewImages, arrays, draw_grid
from imagination.data.collate import Batch
from imagination.data.datamodule import SceneData
from imagination.models.lit_task import LitTask
from imagination.reporting.figures.maps import draw_legend

BACKGROUND = (0, 0, 0)
"""Colour of pixels without a category, RGB."""


class SegmentationImages(ViewImages):
    """Callback that draws RGB, ground truth and predicted segmentation."""

    def draw(self, batch: Batch, task: LitTask, data: SceneData) -> Figure:
        predicted = task.predict_step(batch).cpu().numpy()
        colours = {row.name: row.colour for row in data.observer.categories}
        return draw(arrays(batch), predicted, {name: colours[name] for name in task.categories})


def draw(
    views: dict[str, np.ndarray],
    predicted: UInt8[np.ndarray, "n h w"],
    colours: Mapping[str, tuple[int, int, int]],
) -> Figure:
    """Draw one row for each view: image, ground truth, prediction.

    Args:
        views: batch as arrays.
        predicted: segmentations, 0 for background, else category index + 1.
        colours: RGB colour of each category, in the order of the indices.
    """
    palette = np.array([BACKGROUND, *colours.values()], np.uint8)
    rows = [
        {"Image": rgb.transpose(1, 2, 0), "Ground truth": palette[gt], "Prediction": palette[segmentation]}
        for rgb, gt, segmentation in zip(views["rgb"], views["segmentation"], predicted, strict=True)
    ]
    figure = draw_grid(rows, {})
    draw_legend(figure, {"background": BACKGROUND, **colours})
    return figure
