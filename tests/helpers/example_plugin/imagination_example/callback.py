"""A callback that counts the epochs done."""

from pathlib import Path

from lightning import Callback, LightningModule, Trainer


class CountRounds(Callback):
    """Writes the number of the last round into a file."""

    def __init__(self, file: str) -> None:
        self.file = Path(file)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.file.write_text(str(trainer.current_epoch + 1))
