"""LightningModule with given validation scores, for tests of callbacks."""

from typing import Any

import lightning
import torch
from lightning import LightningModule
from torch import Tensor
from torch.utils.data import DataLoader


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


def quiet_trainer(**options: Any) -> lightning.Trainer:
    """Return a trainer on the CPU without loggers and screen output."""
    settings = {
        "accelerator": "cpu", "logger": False, "enable_progress_bar": False, "enable_model_summary": False,
        "num_sanity_val_steps": 0, "enable_checkpointing": False,
    }  # fmt: skip
    return lightning.Trainer(**(settings | options))


def one_batch() -> DataLoader[Tensor]:
    return DataLoader([torch.ones(1, 1)], batch_size=None)  # type: ignore[arg-type]
