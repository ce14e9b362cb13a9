"""Selection of the best checkpoint."""

from pathlib import Path

import pytest
import torch

from imagination.callbacks.model_checkpoint import BestCheckpoint
from tests.helpers.scored import Scored, one_batch, quiet_trainer


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
    trainer = quiet_trainer(
        max_epochs=5, callbacks=[keep], check_val_every_n_epoch=2, enable_checkpointing=True
    )
    trainer.fit(module, one_batch(), one_batch())
    assert module.validated == [1, 3, 4]
    assert torch.load(tmp_path / "best.ckpt", weights_only=True)["epoch"] == best
    assert [path.name for path in tmp_path.iterdir()] == ["best.ckpt"]
