"""Training statistics: counts and speed."""

import time

import lightning
import pytest
import torch
from lightning import LightningModule
from torch import Tensor
from torch.utils.data import DataLoader

from imagination.callbacks.training_stats import TrainingStats

VIEWS, BATCHES = 4, 3
DRAWING, STEP, COLLECTING = 0.05, 0.02, 0.1  # seconds


class Slow(LightningModule):
    """Module whose step takes a known time."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)
        self.speeds: list[float] = []
        self.steps: list[float] = []

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor:
        if "train/samples_per_second" in self.trainer.callback_metrics:
            self.speeds.append(float(self.trainer.callback_metrics["train/samples_per_second"]))
        self.log("data/collected_views", 7.0)
        self.log("data/collecting_seconds", COLLECTING)
        time.sleep(STEP)
        return self.layer(batch["rgb"]).sum()

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        self.log("val/iou", 0.5 - 0.1 * self.current_epoch)

    def on_validation_end(self) -> None:
        self.steps.append(float(self.trainer.callback_metrics["step"]))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


class Drawn:
    """Batches that take a known time to draw."""

    def __len__(self) -> int:
        return BATCHES

    def __iter__(self):
        for _ in range(BATCHES):
            time.sleep(DRAWING)
            yield {"rgb": torch.ones(VIEWS, 1)}


def test_a_training_is_counted_and_timed_with_its_drawing() -> None:
    module, stats = Slow(), TrainingStats()
    trainer = lightning.Trainer(
        max_epochs=2, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, num_sanity_val_steps=0, callbacks=[stats],
    )  # fmt: skip
    began = time.monotonic()
    validation = DataLoader([{"rgb": torch.ones(VIEWS, 1)}], batch_size=None)
    trainer.fit(module, Drawn(), validation)
    took = time.monotonic() - began
    state = stats.state_dict()
    assert (state["epochs"], state["samples"], state["views"]) == (2, 2 * BATCHES * VIEWS, 7)
    assert state["best"] == pytest.approx(0.5)
    assert 2 * BATCHES * (DRAWING + STEP) <= state["seconds"] <= took
    assert all(0 < speed <= VIEWS / (DRAWING + STEP) for speed in module.speeds) and module.speeds
    waiting = COLLECTING + BATCHES * DRAWING
    assert (
        0.5 * waiting / (waiting + BATCHES * STEP) < float(trainer.callback_metrics["train/waiting"]) < 0.95
    )
    assert module.steps == [BATCHES - 1, 2 * BATCHES - 1]  # the step of each validation

    resumed = TrainingStats()
    resumed.load_state_dict(state)
    assert resumed.state_dict()["samples"] == state["samples"]
