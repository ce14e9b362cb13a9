"""Training curves from a run's TensorBoard files."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

from imagination.evaluation.single_views import CELLS
from imagination.models.task_kind import TaskKind
from imagination.reporting.figures.curves import Curve

FOLDER = "tensorboard"
"""Folder of the event files in the folder of a run."""


COMPARED = {
    "train/loss": ("loss", "loss", "Training loss"),
    "val/iou": ("iou", "IoU", "Single views of validation scenes"),
}
"""Curves that compare networks: name in file names, label of the axis and title, by tag."""


class Chart(NamedTuple):
    """Curves with common axes."""

    stem: str
    title: str
    ylabel: str
    curves: dict[str, Curve]


def read(folder: Path) -> dict[str, Curve]:
    """Read every scalar of a TensorBoard folder by tag, as steps and values; empty without event files."""
    # slow import
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    curves: dict[str, Curve] = {}
    for tag in events.Tags()["scalars"]:
        points = events.Scalars(tag)
        curves[tag] = [point.step for point in points], [point.value for point in points]
    return curves


def compared(networks: Sequence[tuple[str, str, dict[str, Curve]]]) -> list[Chart]:
    """Return charts that compare networks, separately for units and for first-person segmentation.

    Args:
        networks: name, kind of task (see `TaskKind`) and every scalar of each network.
    """
    result = []
    for kind, (tag, (name, ylabel, title)) in product(TaskKind, COMPARED.items()):
        curves = {
            network: scalars[tag]
            for network, trained, scalars in networks
            if trained == kind and tag in scalars
        }
        if curves:
            result.append(Chart(f"curve_{name}_{kind}", f"{title}, {kind.networks}", ylabel, curves))
    return result


def charts(curves: dict[str, Curve]) -> list[Chart]:
    """Return the charts of one training: losses, IoU of single views, global IoU by approach, learning rate."""
    result = []
    tags = {"training": "train/loss", "validation": "val/loss"}
    if losses := {name: curves[tag] for name, tag in tags.items() if tag in curves}:
        result.append(Chart("curve_loss", "Weighted loss", "loss", losses))
    regions = {cells: f"val/iou{'' if cells == 'all' else '_' + cells}" for cells in CELLS}
    if by_cells := {cells: curves[tag] for cells, tag in regions.items() if tag in curves}:
        result.append(Chart("curve_iou", "Single views of validation scenes", "egocentric IoU", by_cells))
    parts = [tag.split("/") for tag in curves if tag.startswith("global/") and tag.endswith("/val")]
    for category in dict.fromkeys(part[1] for part in parts):
        by_approach = {part[2]: curves["/".join(part)] for part in parts if part[1] == category}
        title = f"Global maps of a few validation scenes, {category}"
        result.append(Chart(f"curve_global_{category}", title, "pooled IoU", by_approach))
    if "lr" in curves:
        single = {"learning rate": curves["lr"]}
        result.append(Chart("curve_learning_rate", "Learning rate", "learning rate", single))
    return result
