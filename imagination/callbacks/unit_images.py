"""Images of single views in TensorBoard: observation, label and prediction."""

from typing import Any, cast

import cv2
import numpy as np
import torch
from jaxtyping import Float32, UInt8
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger

from imagination.data.collate import Batch
from imagination.data.datamodule import SceneData
from imagination.evaluation.prediction import Model
from imagination.ground_truth.targets import neighbourhood
from imagination.utils.errors import check_range

PANEL = 192
"""Side of a panel, pixels."""

SEEN, OCCUPIED = (225, 225, 225), (90, 90, 90)
"""Colours of the egocentric map, RGB."""

MAX_DEPTH = 6.0
"""Depth that is drawn white, metres."""


class UnitImages(Callback):
    """Callback that draws views of validation scenes, one row each.

    The panels of a row are RGB, depth, egocentric occupancy, and for each category label, prediction and V_valid.

    Args:
        views: number of views drawn at each validation, evenly spaced in its first batch.
        valid_threshold: τ_valid, the threshold for M*_seen of a prediction.

    Raises:
        UserError: if a value is out of range.
    """

    def __init__(self, views: int, valid_threshold: float) -> None:
        self.views = int(check_range("unit_images.views", views, 1, 64))
        self.valid_threshold = check_range("unit_images.valid_threshold", valid_threshold, 0.0, 1.0)

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        *_: Any,
    ) -> None:
        if batch_idx > 0 or not trainer.is_global_zero:
            return
        data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
        selected = spread(batch, self.views)
        prediction = cast(Model, pl_module).predict(selected).maps.cpu().numpy()
        arrays = {name: tensor.cpu().numpy() for name, tensor in selected.items()}
        add_image(trainer, "views/val", draw(arrays, prediction, self.valid_threshold, data.neighbourhood))


def spread(batch: Batch, max_views: int) -> Batch:
    """Return evenly spaced views of a batch, at most `max_views`."""
    indices = torch.linspace(0, len(batch["rgb"]) - 1, min(max_views, len(batch["rgb"]))).long().tolist()
    return {name: tensor[indices] for name, tensor in batch.items()}


def add_image(trainer: Trainer, tag: str, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Add an image to the TensorBoard loggers of a trainer, at the last completed step."""
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(tag, image, last_step(trainer), dataformats="HWC")


def last_step(trainer: Trainer) -> int:
    """Return the step at which the results of an epoch are logged: its last step, while a checkpoint has the next one.

    The final test is logged at the step after the last, because it is repeated when a finished run is resumed.
    """
    return trainer.global_step - (0 if trainer.testing else 1)


def draw(
    views: dict[str, np.ndarray],
    prediction: Float32[np.ndarray, "n c v v"],
    valid_threshold: float,
    epsilon: int,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw one row of panels for each view.

    Args:
        views: batch as arrays.
        prediction: probabilities of V_object.
        valid_threshold: τ_valid.
        epsilon: side of the kernel ε of M*_seen, cells.
    """
    valid = prediction * neighbourhood(prediction >= valid_threshold, views["seen"] > 0, epsilon)
    rows = []
    for index in range(len(prediction)):
        ego = np.full((*views["seen"].shape[-2:], 3), 255, np.uint8)
        ego[views["seen"][index, 0] > 0] = SEEN
        ego[views["occupied"][index, 0] > 0] = OCCUPIED
        panels = [
            views["rgb"][index].transpose(1, 2, 0),
            _grey(views["depth"][index, 0].astype(np.float32) / MAX_DEPTH),
            ego,
        ]
        for layer in range(prediction.shape[1]):
            for values in (views["label"], prediction, valid):
                panels.append(_grey(values[index, layer].astype(np.float32)))
        rows.append(np.concatenate([_panel(panel) for panel in panels], axis=1))
    return np.concatenate(rows)


def _grey(values: Float32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Convert values from 0 to 1 to grey levels from black to white."""
    return np.repeat((255 * values.clip(0, 1)).astype(np.uint8)[..., None], 3, axis=2)


def _panel(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "side side 3"]:
    """Resize an image to the size of a panel and add a border."""
    size = PANEL - 4
    resized = cv2.resize(np.ascontiguousarray(image), (size, size), interpolation=cv2.INTER_NEAREST)
    return np.pad(resized, ((2, 2), (2, 2), (0, 0)), constant_values=128)
