"""Selection of the best checkpoint, and a run folder that disappears."""

import shutil
from pathlib import Path

import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.demos.boring_classes import BoringModel

from imagination.callbacks.model_checkpoint import BestCheckpoint, MovableCheckpoint
from imagination.runs.folder import COMPOSED
from imagination.utils.errors import UserError
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


class Deleting(Callback):
    """Callback that deletes a folder in the second epoch, as a user might."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.current_epoch == 1:
            shutil.rmtree(self.folder)


def test_a_deleted_run_folder_ends_the_training_with_one_message(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / COMPOSED).touch()
    checkpoint = MovableCheckpoint(dirpath=run / "checkpoints", filename="last", save_on_train_epoch_end=True)
    trainer = Trainer(
        max_epochs=3, limit_train_batches=1, limit_val_batches=0, accelerator="cpu", logger=False,
        callbacks=[checkpoint, Deleting(run)], enable_progress_bar=False, enable_model_summary=False,
        default_root_dir=tmp_path,
    )  # fmt: skip
    with pytest.raises(UserError, match=f"run folder {run}: was deleted or moved"):
        trainer.fit(BoringModel())
    assert trainer.current_epoch == 1 and not run.exists()
