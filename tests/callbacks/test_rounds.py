"""The batches of a round: the same however they are drawn."""

from unittest.mock import Mock

import numpy as np
import pytest
import torch
from lightning import LightningModule, Trainer

from imagination.callbacks import replay_buffer
from imagination.callbacks.replay_buffer import ReplayBufferCallback
from imagination.data.batches import Batch
from imagination.data.datamodule import SceneData


def batches(device: str, accumulate: int) -> list[Batch]:
    """Of the third round, from a hundred views."""
    callback = ReplayBufferCallback(200, 5, 7, 0.9, 0, 0.5, 10)
    callback.buffer.insert(
        {"pose": np.zeros((100, 3)), "rgb": np.arange(4800, dtype=np.uint8).reshape(100, 4, 4, 3)}
    )
    data = Mock(spec=SceneData, seed=1, batch_size=12)
    data.assemble = lambda views: {"rgb": torch.from_numpy(views["rgb"]).permute(0, 3, 1, 2)}
    trainer = Mock(spec=Trainer, current_epoch=2, accumulate_grad_batches=accumulate, datamodule=data)
    trainer.strategy.root_device = torch.device(device)
    callback.on_fit_start(trainer, Mock(spec=LightningModule))
    assert len(data.rounds) == 7 * accumulate
    return list(data.rounds)


@pytest.mark.parametrize("accumulate", [1, 3])
def test_threads_draw_the_batches_that_would_be_drawn_without(
    monkeypatch: pytest.MonkeyPatch, accumulate: int
) -> None:
    monkeypatch.setattr(replay_buffer, "pinned", lambda batch: batch)  # which needs a GPU
    alone, ahead = batches("cpu", accumulate), batches("cuda", accumulate)
    assert len(alone) == len(ahead) == 7 * accumulate
    for one, other in zip(alone, ahead, strict=True):
        assert one.keys() == other.keys() and len(one["rgb"]) == 12 // accumulate
        assert all(torch.equal(one[name], other[name]) for name in one)
    assert not torch.equal(alone[0]["rgb"], alone[accumulate]["rgb"])
