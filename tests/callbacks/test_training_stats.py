"""Training statistics: counts and speed."""

import time
from collections.abc import Iterator
from unittest.mock import Mock

import lightning
import pytest
import torch
from lightning import LightningDataModule, LightningModule, Trainer
from torch import Tensor
from torch.utils.data import DataLoader

from imagination.callbacks import training_stats
from imagination.callbacks.training_stats import TrainingStats
from imagination.data.collection import CollectedViews
from imagination.data.datamodule import SceneData

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
        time.sleep(STEP)
        return self.layer(batch["rgb"]).sum()

    def validation_step(self, batch: dict[str, Tensor], index: int) -> None:
        self.log("val/iou", 0.5 - 0.1 * self.current_epoch)

    def on_validation_end(self) -> None:
        self.steps.append(float(self.trainer.callback_metrics["step"]))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


class Drawn(LightningDataModule):
    """Data module whose views and batches take a known time to collect and draw."""

    collected = Mock(spec=CollectedViews, seconds=COLLECTING, count=7)

    def __len__(self) -> int:
        return BATCHES

    def train_dataloader(self) -> "Drawn":
        return self

    def val_dataloader(self) -> DataLoader:
        return DataLoader([{"rgb": torch.ones(VIEWS, 1)}], batch_size=None)

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        time.sleep(COLLECTING)
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
    trainer.fit(module, datamodule=Drawn())
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


def test_collecting_counts_as_waiting_but_not_in_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 10.0, 12.0, 13.0, 15.0])  # start of the epoch, then begin and end of two steps
    monkeypatch.setattr(training_stats, "perf_counter", lambda: next(clock))
    stats, module = TrainingStats(), Mock(spec=LightningModule, device=torch.device("cpu"))
    collected = Mock(spec=CollectedViews, seconds=9.0, count=7)
    trainer = Mock(spec=Trainer, current_epoch=0, datamodule=Mock(spec=SceneData, collected=collected))
    batch = {"rgb": torch.ones(12, 1)}
    stats.on_train_epoch_start(trainer, module)
    for index in (0, 1):
        stats.on_train_batch_start(trainer, module, batch, index)
        stats.on_train_batch_end(trainer, module, None, batch, index)
    stats.on_train_epoch_end(trainer, module)
    speed = "train/samples_per_second"
    assert [call.args for call in module.log.call_args_list] == [
        (speed, 12 / 3), (speed, 12 / 3), ("train/waiting", 11 / 15),
    ]  # fmt: skip
