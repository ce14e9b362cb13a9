"""Images of the predictions of a unit."""

import numpy as np
from jaxtyping import Float32
from matplotlib.figure import Figure

from imagination.callbacks.view_images import ViewImages, arrays, draw_grid
from imagination.data.collate import Batch
from imagination.data.datamodule import SceneData
from imagination.ground_truth.targets import neighbourhood
from imagination.models.lit_task import LitTask
from imagination.reporting.figures.maps import GROUND_TRUTH, OCCUPIED, draw_legend
from imagination.reporting.figures.views import SEEN, UNSEEN
from imagination.utils.errors import check_range

MAX_DEPTH = 6.0
"""Upper end of the scale of depths, metres."""

MAP = {"cmap": "cividis", "vmin": 0.0, "vmax": 1.0}
"""Colours of probabilities."""


class UnitImages(ViewImages):
    """Callback that draws RGB, depth, the egocentric map with the label, and the prediction with V_valid.

    Args:
        views: maximum number of views.
        valid_threshold: τ_valid, the threshold for M*_seen of a prediction.

    Raises:
        UserError: if a value is out of range.
    """

    def __init__(self, views: int, valid_threshold: float) -> None:
        super().__init__(views)
        self.valid_threshold = check_range("unit_images.valid_threshold", valid_threshold, 0.0, 1.0)

    def draw(self, batch: Batch, task: LitTask, data: SceneData) -> Figure:
        prediction = task.predict_step(batch).maps.cpu().numpy()
        return draw(arrays(batch), prediction, task.categories, self.valid_threshold, data.neighbourhood)


def draw(
    views: dict[str, np.ndarray],
    prediction: Float32[np.ndarray, "n c v v"],
    categories: list[str],
    valid_threshold: float,
    epsilon: int,
) -> Figure:
    """Draw one row of panels for each view.

    Args:
        views: batch as arrays.
        prediction: probabilities of V_object.
        categories: names of the categories.
        valid_threshold: τ_valid.
        epsilon: side of the kernel ε of M*_seen, cells.
    """
    valid = prediction * neighbourhood(prediction >= valid_threshold, views["seen"] > 0, epsilon)
    rows = []
    for index in range(len(prediction)):
        panels = {
            "Image": views["rgb"][index].transpose(1, 2, 0),
            f"Depth, 0 to {MAX_DEPTH:g} m": views["depth"][index, 0].astype(np.float32),
        }
        for layer, category in enumerate(categories):
            ego = np.full((*views["seen"].shape[-2:], 3), UNSEEN, np.uint8)
            ego[views["seen"][index, 0] > 0] = SEEN
            ego[views["occupied"][index, 0] > 0] = OCCUPIED
            ego[views["label"][index, layer] > 0] = GROUND_TRUTH
            panels[f"Label, {category}"] = ego
            panels[f"Prediction, {category}"] = prediction[index, layer]
            panels[f"V_valid, {category}"] = valid[index, layer]
        rows.append(panels)
    options = {name: MAP for name in rows[0] if name.startswith(("Prediction", "V_valid"))}
    depth = {f"Depth, 0 to {MAX_DEPTH:g} m": {"cmap": "gray", "vmin": 0.0, "vmax": MAX_DEPTH}}
    figure = draw_grid(rows, options | depth, margin=0.9)
    last = [axis for axis in figure.axes if axis.images and axis.images[0].cmap.name == MAP["cmap"]]
    shrink = min(1.0, 2.0 / len(rows))
    figure.colorbar(
        last[-1].images[0], ax=figure.axes, label="probability", shrink=shrink, aspect=12, pad=0.01
    )
    colours = {"label": GROUND_TRUTH, "occupied": OCCUPIED, "seen": SEEN, "not seen": UNSEEN}
    draw_legend(figure, colours)
    return figure
