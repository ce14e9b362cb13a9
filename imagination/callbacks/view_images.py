"""Images for the loggers: validation views with their ground truth and predictions, drawn by task."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import UInt8
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from imagination.data.collate import Batch
from imagination.data.datamodule import SceneData
from imagination.models.lit_task import LitTask
from imagination.reporting import style
from imagination.reporting.figures.maps import bare
from imagination.utils.errors import check_range

DPI = 100
"""Resolution of the images, pixels per inch."""


class ViewImages(Callback, ABC):
    """Callback that draws validation views at the end of each validation, one row each, with tag `views/val`.

    The views are those with the largest ground truth, of all batches, and the same at every validation.

    Args:
        views: maximum number of views.

    Raises:
        UserError: if the number of views is out of range.
    """

    def __init__(self, views: int) -> None:
        self.views = int(check_range("views", views, 1, 64))
        self._kept: list[Batch] = []

    @abstractmethod
    def draw(self, batch: Batch, task: LitTask, data: SceneData) -> Figure:
        """Draw the views of a batch and their predictions."""

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._kept = []

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        *_: Any,
    ) -> None:
        if trainer.is_global_zero and trainer.loggers and not trainer.sanity_checking:
            batches = max(1, int(sum(trainer.num_val_batches)))
            self._kept.append(largest(batch, cast(LitTask, pl_module).target, -(-self.views // batches)))

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self._kept:
            return
        task, data = cast(LitTask, pl_module), cast(SceneData, trainer.datamodule)  # type: ignore[attr-defined]
        kept = {name: torch.cat([batch[name] for batch in self._kept]) for name in self._kept[0]}
        shown = largest(kept, task.target, self.views)
        if len(shown["rgb"]):
            with style.theme("light"):
                add_image(trainer, "views/val", to_image(self.draw(shown, task, data)))
        self._kept = []


def largest(batch: Batch, target: str, count: int) -> Batch:
    """Return the views of a batch with the largest ground truth (the entry `target`): `count`, or all that have any."""
    sizes = (batch[target] > 0).flatten(1).sum(dim=1)
    number = min(count, int((sizes > 0).sum()))
    indices = sizes.argsort(descending=True, stable=True)[:number].tolist()
    return {name: tensor[indices] for name, tensor in batch.items()}


def arrays(batch: Batch) -> dict[str, np.ndarray]:
    """Return the tensors of a batch as NumPy arrays."""
    return {name: tensor.cpu().numpy() for name, tensor in batch.items()}


def draw_grid(
    panels: Sequence[Mapping[str, np.ndarray]], options: Mapping[str, Mapping[str, Any]], margin: float = 0.0
) -> Figure:
    """Draw one row of panels for each view.

    Args:
        panels: images of each view by title.
        options: arguments of `imshow` by title.
        margin: additional width, inches.
    """
    titles = list(panels[0])
    figure = Figure(figsize=(2.0 * len(titles) + margin, 2.0 * len(panels) + 0.7), layout="constrained")
    axes = figure.subplots(len(panels), len(titles), squeeze=False)
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title)
    for row, images in zip(axes, panels, strict=True):
        for axis, (title, image) in zip(row, images.items(), strict=True):
            axis.imshow(image, **options.get(title, {}))
            bare(axis)
    return figure


def to_image(figure: Figure) -> UInt8[np.ndarray, "h w 3"]:
    """Return the pixels of a figure."""
    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def add_image(trainer: Trainer, tag: str, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Add an image to the loggers that take images, at the last completed step."""
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(tag, image, last_step(trainer), dataformats="HWC")
        elif hasattr(logger, "log_image"):  # Weights & Biases
            logger.log_image(tag, [image], step=last_step(trainer))


def last_step(trainer: Trainer) -> int:
    """Return the step at which the results of an epoch are logged: its last step, while a checkpoint has the next one.

    The final test is logged at the step after the last, because it is repeated when a finished run is resumed.
    """
    return trainer.global_step - (0 if trainer.testing else 1)
