"""Progress bar of training."""

from collections.abc import Callable
from contextlib import ExitStack

from lightning import Callback, LightningModule, Trainer

from imagination.utils.progress import bar


class ProgressBar(Callback):
    """Callback that shows the number of completed epochs."""

    def __init__(self) -> None:
        self._open = ExitStack()
        self._advance: Callable[[], None] = lambda: None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        remaining = (trainer.max_epochs or 0) - trainer.current_epoch
        self._advance = self._open.enter_context(bar("training epochs", remaining))

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._advance()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._open.close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._open.close()
