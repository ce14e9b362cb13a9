"""Batches of an epoch: the same with any number of workers, with and without prefetching, and in resumed trainings."""

from collections import defaultdict
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import lightning
import numpy as np
import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor

from imagination.data import batches as module
from imagination.data.batches import EpochBatches
from imagination.data.collate import Batch
from imagination.data.collection import CollectedViews
from imagination.data.datamodule import SceneData
from imagination.data.replay_buffer import ReplaySettings
from imagination.utils.errors import UserError
from imagination.views.collector import Collector
from tests.data.test_datamodule import REPLAY, data


def drawn(device: str, micro_batches: int, epoch: int = 2, overfit: int = 0) -> list[Batch]:
    """Return the batches of an epoch, drawn from two hundred views."""
    views = {"pose": np.zeros((100, 3)), "rgb": np.arange(4800, dtype=np.uint8).reshape(100, 4, 4, 3)}
    collector = Mock(spec=Collector, views_per_collection=100, start=lambda index: lambda: views)
    collected = CollectedViews(ReplaySettings(200, 5, 7, 0.9, 5, 10), lambda: collector, list(views), 2)
    trainer = Mock(spec=Trainer, current_epoch=epoch, max_epochs=5, overfit_batches=overfit)
    trainer.strategy.root_device = torch.device(device)
    trainer.lightning_module.batch_totals = lambda batch: {}

    def assemble(views: dict[str, np.ndarray]) -> Batch:
        return {"rgb": torch.from_numpy(views["rgb"]).permute(0, 3, 1, 2)}

    loader = EpochBatches(collected, assemble, 12, micro_batches, 0.5, 1, trainer)
    assert len(loader) == 7 * micro_batches
    return list(loader)


def equal(one: list[Batch], other: list[Batch]) -> bool:
    return len(one) == len(other) and all(
        a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("micro_batches", [1, 3])
def test_prefetching_does_not_change_the_batches(monkeypatch: pytest.MonkeyPatch, micro_batches: int) -> None:
    monkeypatch.setattr(module, "pinned", lambda batch: batch)  # pinning needs a GPU
    on_demand, prefetched = drawn("cpu", micro_batches), drawn("cuda", micro_batches)
    assert len(on_demand) == 7 * micro_batches and equal(on_demand, prefetched)
    assert all(len(batch["rgb"]) == 12 // micro_batches for batch in on_demand)
    assert not torch.equal(on_demand[0]["rgb"], on_demand[micro_batches]["rgb"])


def test_overfitting_draws_the_same_batches_in_every_epoch() -> None:
    """With `trainer.overfit_batches`; in an ordinary training every epoch has its own batches."""
    assert equal(drawn("cpu", 1, 0, overfit=3), drawn("cpu", 1, 2, overfit=3))
    assert not equal(drawn("cpu", 1, 0), drawn("cpu", 1, 2))


class Recorder(LightningModule):
    """Module that keeps the batches of each epoch."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)
        self.kept: dict[int, list[Batch]] = defaultdict(list)

    def training_step(self, batch: Batch, index: int) -> Tensor:
        self.kept[self.current_epoch].append(batch)
        return self.layer(torch.ones(1, 1)).sum()

    def validation_step(self, batch: Batch, index: int) -> None:
        pass

    def batch_totals(self, batch: Batch) -> Batch:
        return {"views": torch.tensor(len(batch["rgb"]))}

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(data: SceneData, epochs: int, checkpoint: str | None = None, **arguments: Any) -> Recorder:
    """Return the recorder of a training, whose `trainer` holds the logged values."""
    recorder = Recorder()
    trainer = lightning.Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False,
        **arguments,
    )  # fmt: skip
    trainer.fit(recorder, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    return recorder


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_batches_depend_neither_on_workers_nor_on_resumption(tmp_path: Path, workers: int) -> None:
    checkpoints = ModelCheckpoint(tmp_path, "{epoch}", save_top_k=-1, save_on_train_epoch_end=True)
    folders = iter(str(number) for number in range(9))  # nothing is read from the cache of another training

    def trained(workers: int, *arguments: Any, **others: Any) -> dict[int, list[Batch]]:
        views = data(tmp_path / next(folders), workers=workers, replay=REPLAY, hflip_probability=0.5)
        return fit(views, *arguments, **others).kept

    whole = trained(0, 4, callbacks=[checkpoints])
    assert list(whole) == [0, 1, 2, 3] and all(len(batches) == 3 for batches in whole.values())
    assert not equal(whole[1], whole[2])
    pooled = trained(workers, 4, enable_checkpointing=False, num_sanity_val_steps=0)
    resumed = trained(workers, 4, str(tmp_path / "epoch=1.ckpt"), enable_checkpointing=False)
    assert list(pooled) == [0, 1, 2, 3] and list(resumed) == [2, 3]
    assert all(equal(whole[epoch], pooled[epoch]) for epoch in pooled)
    assert all(equal(whole[epoch], resumed[epoch]) for epoch in resumed)


def test_a_second_training_starts_over(tmp_path: Path) -> None:
    views = data(tmp_path, replay=REPLAY)
    first, second = (fit(views, 2, enable_checkpointing=False).kept for _ in range(2))
    assert all(equal(first[epoch], second[epoch]) for epoch in (0, 1))


def test_reloading_keeps_the_batches(tmp_path: Path) -> None:
    kept = [
        fit(data(tmp_path, replay=REPLAY), 2, enable_checkpointing=False, reload_dataloaders_every_n_epochs=n).kept
        for n in (0, 1)
    ]  # fmt: skip
    assert all(equal(kept[0][epoch], kept[1][epoch]) for epoch in (0, 1))


def test_a_loader_without_a_trainer_has_the_batches_of_the_first_epoch(tmp_path: Path) -> None:
    trained = fit(data(tmp_path, replay=REPLAY), 1, enable_checkpointing=False).kept[0]
    alone = data(tmp_path, replay=REPLAY)
    assert equal(list(alone.train_dataloader()), trained)
    split = data(tmp_path, replay=REPLAY, micro_batches=3)
    with pytest.raises(UserError, match="data.micro_batches: got 3 without a trainer"):
        next(iter(split.train_dataloader()))


def test_micro_batches_make_up_their_batch(tmp_path: Path) -> None:
    whole, split = (
        fit(data(tmp_path, replay=REPLAY, micro_batches=count), 1, enable_checkpointing=False).kept[0]
        for count in (1, 3)
    )
    assert len(split) == 3 * len(whole)
    for number, batch in enumerate(whole):
        micro_batches = split[3 * number : 3 * number + 3]
        assert torch.equal(torch.cat([part["rgb"] for part in micro_batches]), batch["rgb"])
        assert all((part["views"], part["micro_batches"]) == (3, 3) for part in micro_batches)
    with pytest.raises(UserError, match=r"data.micro_batches: got 4, expected a number in \[1, 3\]"):
        data(tmp_path, replay=REPLAY, micro_batches=4).train_dataloader()
