"""Training statistics: epochs, samples, views and duration."""

from time import monotonic, perf_counter
from typing import Any, cast

import torch
from lightning import Callback, LightningModule, Trainer

from imagination.callbacks.view_images import last_step
from imagination.data.collate import Batch
from imagination.data.collection import CollectedViews
from imagination.data.datamodule import SceneData
from imagination.utils.process_group import world_size


class TrainingStats(Callback):
    """Callback that counts epochs, samples, views and seconds over all resumptions of a run.

    The counts are saved in checkpoints and appear in the tables of an evaluation. The callback also logs the training
    speed, including the drawing of batches but not the collection of views; the fraction of an epoch spent waiting for
    the collection of views or between steps (batches, loggers); and the step at which loggers show a validation.
    """

    def __init__(self) -> None:
        self._counts = {"epochs": 0, "samples": 0, "views": 0, "seconds": 0.0, "best": 0.0}
        self._since = monotonic()
        self._batch_begin = self._batch_end = 0.0
        self._seconds_between_steps = self._seconds_in_epoch = 0.0  # of the current epoch so far

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._since = monotonic()

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._batch_end = perf_counter()
        self._seconds_between_steps = self._seconds_in_epoch = 0.0

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Batch, batch_idx: int
    ) -> None:
        self._batch_begin = perf_counter()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        if pl_module.device.type == "cuda":  # wait for asynchronous kernels
            torch.cuda.synchronize()
        samples, now = len(batch["rgb"]) * world_size(), perf_counter()
        self._counts["samples"] += samples
        collecting = _collected(trainer).seconds if batch_idx == 0 else 0.0  # before the first batch is drawn
        pl_module.log("train/samples_per_second", samples / (now - self._batch_end - collecting))
        self._seconds_between_steps += self._batch_begin - self._batch_end
        self._seconds_in_epoch += now - self._batch_end
        self._batch_end = now

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        pl_module.log("step", float(last_step(trainer)))

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.sanity_checking:  # its scores are not logged
            return
        self._counts["best"] = max(self._counts["best"], float(trainer.callback_metrics["val/iou"]))

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._counts["epochs"] = trainer.current_epoch + 1
        self._counts["views"] = _collected(trainer).count
        pl_module.log("train/waiting", self._seconds_between_steps / self._seconds_in_epoch)

    def state_dict(self) -> dict[str, Any]:
        now = monotonic()
        self._counts["seconds"] += now - self._since
        self._since = now
        return dict(self._counts)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._counts = dict(state_dict)


def _collected(trainer: Trainer) -> CollectedViews:
    return cast(SceneData, trainer.datamodule).collected  # type: ignore[attr-defined]
