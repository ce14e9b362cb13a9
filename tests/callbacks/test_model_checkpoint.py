"""Selection of the best checkpoint."""

from pathlib import Path

import lightning
import pytest
import torch
from lightning import LightningModule
from torch import Tensor
from torch.utils.data import DataLoader

from imagination.callbacks.model_checkpoint import BestCheckpoint


class Scored(LightningModule):
    """Module with a given score in each epoch."""

    def __init__(self, scores: list[float]) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)
        self.scores = scores
        self.validated: list[int] = []

    def training_step(self, batch: Tensor, index: int) -> Tensor:
        return self.layer(batch).sum()

    def validation_step(self, batch: Tensor, index: int) -> None:
        self.validated.append(self.current_epoch)
        self.log("val/iou", self.scores[self.current_epoch])

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.mark.parametrize(
    ("scores", "best"), [([0.9, 0.3, 0.8, 0.4, 0.5], 4), ([0.9, 0.3, 0.9, 0.6, 0.5], 3), ([0.1] * 5, 1)]
)
def test_the_last_epoch_is_validated_and_may_be_the_best(
    tmp_path: Path, scores: list[float], best: int
) -> None:
    """Every second of five epochs and the last one are validated."""
    module = Scored(scores)
    keep = BestCheckpoint(
        dirpath=tmp_path, filename="best", monitor="val/iou", mode="max", every_n_epochs=1,
        save_on_train_epoch_end=True, enable_version_counter=False,
    )  # fmt: skip
    trainer = lightning.Trainer(
        max_epochs=5, accelerator="cpu", logger=False, callbacks=[keep], enable_progress_bar=False,
        enable_model_summary=False, num_sanity_val_steps=0, check_val_every_n_epoch=2,
    )  # fmt: skip
    batches = DataLoader([torch.ones(1, 1)], batch_size=None)
    trainer.fit(module, batches, batches)
    assert module.validated == [1, 3, 4]
    assert torch.load(tmp_path / "best.ckpt", weights_only=True)["epoch"] == best
    assert [path.name for path in tmp_path.iterdir()] == ["best.ckpt"]
