"""Early stopping that resumed runs reproduce."""

import logging

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import early_stopping

from imagination.utils.errors import check_range

log = logging.getLogger(__name__)


class EarlyStopping(early_stopping.EarlyStopping):
    """Lightning's EarlyStopping on a score of which higher is better, checked after each validation.

    Training lasts at least `trainer.min_epochs`. This class adds three things:

    - The score before `min_epochs` requests no stop. Lightning would keep the request even if the score improves
      afterwards, and a resumed run would not know of it.
    - A finished run that is resumed ends at once, not after its next validation.
    - A training that ended at `max_epochs` while its score still improved is reported.

    Args:
        monitor: name of the score, e.g. "val/iou".
        patience: number of validations without improvement.
        min_delta: minimum improvement over the best score.

    Raises:
        UserError: if a value is out of range.
    """

    def __init__(self, monitor: str, patience: int, min_delta: float) -> None:
        check_range("early_stopping.patience", patience, 1, 10_000, "validations")
        check_range("early_stopping.min_delta", min_delta, 0.0, 1.0)
        super().__init__(monitor, min_delta, patience, mode="max", check_on_train_epoch_end=False)

    @property
    def flat(self) -> bool:
        """Whether the last `patience` scores did not improve on the best score."""
        return self.wait_count >= self.patience

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        finished = self.flat and trainer.current_epoch >= (trainer.min_epochs or 0)
        trainer.should_stop = trainer.should_stop or finished

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        requested = trainer.should_stop  # by others
        super().on_validation_end(trainer, pl_module)
        if trainer.current_epoch + 1 < (trainer.min_epochs or 0):
            trainer.should_stop = requested

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        min_epochs = trainer.min_epochs or 0
        if trainer.fast_dev_run:  # type: ignore[attr-defined]  # Lightning sets it at runtime
            return
        if not self.flat or trainer.current_epoch < min_epochs:
            log.warning(
                "Training ended after %d epochs, before %s was flat and trainer.min_epochs, %d, were done; raise "
                "trainer.max_epochs and resume the run",
                trainer.current_epoch,
                self.monitor,
                min_epochs,
            )
