"""Callback that counts completed epochs."""

from pathlib import Path

from lightning import Callback, LightningModule, Trainer


class CountEpochs(Callback):
    """Callback that writes the number of completed epochs into a file.

    Args:
        file: path of the file.
    """

    def __init__(self, file: str) -> None:
        self.file = Path(file)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.file.write_text(str(trainer.current_epoch + 1))
