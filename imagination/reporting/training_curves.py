"""Training curves from a run's TensorBoard files."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

from imagination.evaluation.single_views import CELLS
from imagination.reporting.figures.curves import Curve

FOLDER = "tensorboard"
"""In a run's folder."""


COMPARED = {
    "train/loss": ("loss", "loss", "Training loss"),
    "val/iou": ("iou", "IoU", "Single views of validation scenes"),
}
"""Curves by which networks are compared: their name in files and on the axis, and what they are of."""

KINDS = {"maps": "units", "images": "first-person segmentation"}
"""What networks predict, and what those that do are called."""


class Chart(NamedTuple):
    """Curves that share axes."""

    stem: str
    title: str
    up: str
    curves: dict[str, Curve]


def read(folder: Path) -> dict[str, Curve]:
    """Every scalar of a TensorBoard folder by tag: steps and values; without any where nothing was logged."""
    # slow to import
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    curves: dict[str, Curve] = {}
    for tag in events.Tags()["scalars"]:
        points = events.Scalars(tag)
        curves[tag] = [point.step for point in points], [point.value for point in points]
    return curves


def compared(networks: Sequence[tuple[str, str, dict[str, Curve]]]) -> list[Chart]:
    """The same curve of several networks together, apart for units and for first-person segmentation.

    Args:
        networks: name, what it predicts, and every scalar of each.
    """
    made = []
    for (kind, called), (tag, (name, up, title)) in product(KINDS.items(), COMPARED.items()):
        of = {
            network: found[tag] for network, predicts, found in networks if predicts == kind and tag in found
        }
        if of:
            made.append(Chart(f"curve_{name}_{kind}", f"{title}, {called}", up, of))
    return made


def charts(curves: dict[str, Curve]) -> list[Chart]:
    """What is drawn of them: losses, IoU of single views, global IoU by approach, learning rate."""
    made = []
    tags = {"training": "train/loss", "validation": "val/loss"}
    if losses := {name: curves[tag] for name, tag in tags.items() if tag in curves}:
        made.append(Chart("curve_loss", "Weighted loss", "loss", losses))
    regions = {cells: f"val/iou{'' if cells == 'all' else '_' + cells}" for cells in CELLS}
    if found := {cells: curves[tag] for cells, tag in regions.items() if tag in curves}:
        made.append(Chart("curve_iou", "Single views of validation scenes", "egocentric IoU", found))
    parts = [tag.split("/") for tag in curves if tag.startswith("global/") and tag.endswith("/val")]
    for category in dict.fromkeys(part[1] for part in parts):
        of = {part[2]: curves["/".join(part)] for part in parts if part[1] == category}
        title = f"Global maps of a few validation scenes, {category}"
        made.append(Chart(f"curve_global_{category}", title, "pooled IoU", of))
    if "train/learning_rate" in curves:
        one = {"learning rate": curves["train/learning_rate"]}
        made.append(Chart("curve_learning_rate", "Learning rate", "learning rate", one))
    return made
