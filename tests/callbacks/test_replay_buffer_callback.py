"""Batches of an epoch: the same with and without prefetching."""

from collections.abc import Callable
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from lightning import LightningModule, Trainer

from imagination.callbacks import replay_buffer
from imagination.callbacks.replay_buffer import ReplayBufferCallback
from imagination.data.collate import Batch
from imagination.data.datamodule import SceneData
from imagination.models.lit_task import LitTask
from imagination.views.collector import Collector


def batches(device: str, accumulate: int, epoch: int = 2, overfit: int = 0) -> list[Batch]:
    """Return the batches of an epoch, drawn from a hundred views."""
    callback = ReplayBufferCallback(200, 5, 7, 0.9, 0, 0.5, 10)
    callback.buffer.insert(
        {"pose": np.zeros((100, 3)), "rgb": np.arange(4800, dtype=np.uint8).reshape(100, 4, 4, 3)}
    )
    data = Mock(spec=SceneData, seed=1, batch_size=12, micro_batches=accumulate)
    data.assemble = lambda views: {"rgb": torch.from_numpy(views["rgb"]).permute(0, 3, 1, 2)}
    trainer = Mock(spec=Trainer, current_epoch=epoch, max_epochs=5, datamodule=data, overfit_batches=overfit)
    trainer.strategy.root_device = torch.device(device)
    callback.on_fit_start(trainer, Mock(spec=LitTask, batch_totals=lambda batch: {}))
    assert len(data.epochs) == 7 * accumulate
    return list(data.epochs)


@pytest.mark.parametrize("accumulate", [1, 3])
def test_prefetching_does_not_change_the_batches(monkeypatch: pytest.MonkeyPatch, accumulate: int) -> None:
    monkeypatch.setattr(replay_buffer, "pinned", lambda batch: batch)  # pinning needs a GPU
    on_demand, prefetched = batches("cpu", accumulate), batches("cuda", accumulate)
    assert len(on_demand) == len(prefetched) == 7 * accumulate
    for one, other in zip(on_demand, prefetched, strict=True):
        assert one.keys() == other.keys() and len(one["rgb"]) == 12 // accumulate
        assert all(torch.equal(one[name], other[name]) for name in one)
    assert not torch.equal(on_demand[0]["rgb"], on_demand[accumulate]["rgb"])


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        # the buffer holds all 5 collections of 10 views: nothing is collected after them
        (100, [[0, 1, 2], [3], [4], [], []]),
        # the buffer holds two collections: the collections are repeated in their order
        (20, [[1, 2], [3], [4], [0], [1]]),
    ],
)
def test_epochs_after_the_last_collection_reuse_the_views(size: int, expected: list[list[int]]) -> None:
    requested: list[int] = []

    def start(index: int) -> Callable[[], dict[str, np.ndarray]]:
        def wait() -> dict[str, np.ndarray]:
            requested.append(index)
            return {"pose": np.full((10, 3), float(index))}

        return wait

    collector = Mock(spec=Collector, views_per_collection=10, start=start)
    data = Mock(spec=SceneData, seed=1, batch_size=4, workers=1, fields=("pose",), epochs=range(7))
    data.collector.return_value = collector
    # two collections before the first epoch, then three
    callback = ReplayBufferCallback(size, 5, 7, 0.5, 10, 0.0, 3)
    collected = []
    for epoch, indices in enumerate(expected):
        trainer = Mock(
            spec=Trainer, current_epoch=epoch, max_epochs=5, datamodule=data, overfit_batches=0,
            num_training_batches=7,
        )  # fmt: skip
        module = Mock(spec=LightningModule)
        requested.clear()
        callback.on_train_epoch_start(trainer, module)
        assert requested == indices
        logged = {call.args[0]: call.args[1] for call in module.log.call_args_list}
        collected.append(logged["data/collected_views"])
    assert collected == [30, 40, 50, 50, 50]
    resumed = ReplayBufferCallback(
        size, 5, 7, 0.5, 10, 0.0, 3
    )  # has the same views as the uninterrupted callback
    resumed.on_train_epoch_start(trainer, module)
    rng = np.random.default_rng(0), np.random.default_rng(0)
    draws = [each.buffer.draw(4, own)["pose"] for each, own in zip((callback, resumed), rng, strict=True)]
    np.testing.assert_array_equal(*draws)


def test_overfitting_draws_the_same_batches_in_every_epoch() -> None:
    """With `trainer.overfit_batches`; in an ordinary training every epoch has its own batches."""
    for overfit, equal in ((3, True), (0, False)):
        first, other = (batches("cpu", 1, epoch, overfit) for epoch in (0, 2))
        assert all(torch.equal(a["rgb"], b["rgb"]) for a, b in zip(first, other, strict=True)) == equal
