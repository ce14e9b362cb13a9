"""Seeding of random generators per epoch."""

from lightning import Callback, LightningModule, Trainer, seed_everything


class SeedPerEpoch(Callback):
    """Callback that seeds all generators at the start of each epoch, so that a resumed run needs no saved states.

    Args:
        seed: seed of the run.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        seed_everything((self.seed * 1_000_003 + trainer.current_epoch) % 2**32, verbose=False)
