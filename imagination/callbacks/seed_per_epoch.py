"""Random states that a resumed run finds again."""

from lightning import Callback, LightningModule, Trainer, seed_everything


class SeedPerEpoch(Callback):
    """Seeds all generators at the start of each round from the seed and the round, so that no state has to be saved.

    Args:
        seed: of the run.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        seed_everything((self.seed * 1_000_003 + trainer.current_epoch) % 2**32, verbose=False)
