"""Progress bar over the epochs of a training."""

from collections.abc import Callable
from contextlib import ExitStack

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar

from imagination.utils.progress import bar


class EpochProgressBar(ProgressBar):
    """Progress bar that counts epochs and writes lines where there is no terminal.

    Lightning's bars count the batches of an epoch, which takes seconds here, and write nothing useful into a log file.
    One of them may replace this one: `callbacks.progress_bar._target_=lightning.pytorch.callbacks.TQDMProgressBar`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._enabled = True
        self._open = ExitStack()
        self._advance: Callable[[], None] = lambda: None

    def disable(self) -> None:
        self._enabled = False

    def enable(self) -> None:
        self._enabled = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._enabled:
            remaining = (trainer.max_epochs or 0) - trainer.current_epoch
            self._advance = self._open.enter_context(bar("training epochs", remaining))

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._advance()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._open.close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._open.close()
