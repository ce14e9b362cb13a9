"""Early stopping on a validation score."""

import logging
from typing import Any

from lightning import Callback, LightningModule, Trainer

from imagination.utils.errors import check_range

log = logging.getLogger(__name__)


class EarlyStopping(Callback):
    """Callback that ends training when the score is flat and the learning-rate schedule has ended.

    The score is flat if it did not exceed the best score by more than `min_delta` in `patience` consecutive
    validations. The state is saved in checkpoints, so that a resumed run stops at the same epoch.

    Args:
        monitor: name of the score, e.g. "val/iou"; higher is better.
        patience: number of validations without improvement.
        min_delta: minimum improvement over the best score.
        min_epochs: minimum number of epochs, those of the learning-rate schedule.

    Raises:
        UserError: if a value is out of range.
    """

    def __init__(self, monitor: str, patience: int, min_delta: float, min_epochs: int) -> None:
        self.monitor = monitor
        self.patience = int(check_range("early_stopping.patience", patience, 1, 10_000, "validations"))
        self.min_delta = check_range("early_stopping.min_delta", min_delta, 0.0, 1.0)
        self.min_epochs = int(check_range("early_stopping.min_epochs", min_epochs, 1, 10**9, "epochs"))
        self._best, self._waited = float("-inf"), 0

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        score = float(trainer.callback_metrics[self.monitor])
        if score > self._best + self.min_delta:
            self._best, self._waited = score, 0
            return
        self._waited += 1
        self._end_if_flat(trainer, trainer.current_epoch + 1)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._end_if_flat(trainer, trainer.current_epoch)  # when a finished run is resumed

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self.flat or trainer.current_epoch < self.min_epochs:
            log.warning(
                "Training ended after %d epochs, before %s was flat and the %d epochs of the learning-rate schedule "
                "were done; raise trainer.max_epochs and resume the run",
                trainer.current_epoch,
                self.monitor,
                self.min_epochs,
            )

    @property
    def flat(self) -> bool:
        """Whether the last `patience` scores did not improve on the best score."""
        return self._waited >= self.patience

    def _end_if_flat(self, trainer: Trainer, epochs: int) -> None:
        trainer.should_stop = trainer.should_stop or (self.flat and epochs >= self.min_epochs)

    def state_dict(self) -> dict[str, Any]:
        return {"best": self._best, "waited": self._waited, "flat": self.flat}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._best, self._waited = state_dict["best"], state_dict["waited"]
