"""Pictures of single views in TensorBoard: what the robot sees, what it should imagine, what it does."""

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
"""Metres that are drawn brightest."""


class UnitImages(Callback):
    """Draws views of validation scenes, one row each: RGB, depth, egocentric occupancy, and for each category label,
    prediction and valid imagination.

    Args:
        views: drawn at each validation, spread over its first batch.
        valid_threshold: tau_valid, for M*_seen.
    """

    def __init__(self, views: int, valid_threshold: float) -> None:
        self.views = int(check_range("pictures.views", views, 1, 64))
        self.valid_threshold = check_range("pictures.valid_threshold", valid_threshold, 0.0, 1.0)

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
        chosen = spread(batch, self.views)
        prediction = cast(Model, pl_module).predict(chosen).maps.cpu().numpy()
        arrays = {name: tensor.cpu().numpy() for name, tensor in chosen.items()}
        add_image(trainer, "views/val", draw(arrays, prediction, self.valid_threshold, data.neighbourhood))


def spread(batch: Batch, most: int) -> Batch:
    """Some of a batch's views, evenly spread."""
    picks = torch.linspace(0, len(batch["rgb"]) - 1, min(most, len(batch["rgb"]))).long().tolist()
    return {name: tensor[picks] for name, tensor in batch.items()}


def add_image(trainer: Trainer, tag: str, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Show an image in TensorBoard, where the trainer logs to it, at the last step that was done."""
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(tag, image, last_step(trainer), dataformats="HWC")


def last_step(trainer: Trainer) -> int:
    """Step that TensorBoard shows for what belongs to a round: its last, so that a checkpoint's step begins the next.

    The final test, made anew when a finished run goes on, has the step after the last.
    """
    return trainer.global_step - (0 if trainer.testing else 1)


def draw(
    views: dict[str, np.ndarray],
    prediction: Float32[np.ndarray, "n c v v"],
    valid_threshold: float,
    epsilon: int,
) -> UInt8[np.ndarray, "height width 3"]:
    """One row of panels for each view.

    Args:
        views: a batch as arrays.
        prediction: probabilities.
        valid_threshold: tau_valid.
        epsilon: kernel of M*_seen, cells.
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
    """0 to 1 as black to white."""
    return np.repeat((255 * values.clip(0, 1)).astype(np.uint8)[..., None], 3, axis=2)


def _panel(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "side side 3"]:
    """The image at the size of a panel, with a rim."""
    size = PANEL - 4
    resized = cv2.resize(np.ascontiguousarray(image), (size, size), interpolation=cv2.INTER_NEAREST)
    return np.pad(resized, ((2, 2), (2, 2), (0, 0)), constant_values=128)
