"""The trainer of a config: what each argument changes."""

from pathlib import Path

import lightning
import pytest
from lightning.pytorch.callbacks import Checkpoint, LearningRateMonitor, ModelSummary, ProgressBar
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.profilers import SimpleProfiler
from lightning.pytorch.strategies import DDPStrategy

from imagination.config.compose import compose
from imagination.runs.trainer import make_trainer
from imagination.utils.errors import UserError


def trainer(folder: Path, *overrides: str) -> lightning.Trainer:
    job = ["experiment=chair_unet", "scale=test", f"paths.run={folder}", "trainer.accelerator=cpu"]
    return make_trainer(compose("train", [*job, *overrides]), first_step=7)


def has(made: lightning.Trainer, kind: type) -> bool:
    return any(isinstance(callback, kind) for callback in made.callbacks)  # type: ignore[attr-defined]


def test_the_default_has_a_logger_and_all_callbacks(tmp_path: Path) -> None:
    made = trainer(tmp_path)
    (logger,) = made.loggers
    assert isinstance(logger, TensorBoardLogger) and Path(logger.log_dir) == tmp_path / "tensorboard"
    assert logger._kwargs["purge_step"] == 7
    assert all(has(made, kind) for kind in (ProgressBar, Checkpoint, LearningRateMonitor))
    assert not has(made, ModelSummary)


@pytest.mark.parametrize(
    ("override", "kind"),
    [
        ("trainer.enable_progress_bar=false", ProgressBar),
        ("trainer.enable_checkpointing=false", Checkpoint),
        ("logger=null", LearningRateMonitor),
    ],
)
def test_a_disabled_callback_is_left_out(tmp_path: Path, override: str, kind: type) -> None:
    assert not has(trainer(tmp_path, override), kind)


def test_several_loggers(tmp_path: Path) -> None:
    made = trainer(tmp_path, "logger=many")
    assert [type(logger) for logger in made.loggers] == [TensorBoardLogger, CSVLogger]
    assert not trainer(tmp_path, "logger=null").loggers


def test_arguments_reach_the_trainer(tmp_path: Path) -> None:
    made = trainer(
        tmp_path, "+trainer.profiler=simple", "+trainer.max_steps=5", "+trainer.limit_train_batches=1",
        "trainer.enable_model_summary=true", "trainer.min_epochs=2", "trainer.num_sanity_val_steps=1",
    )  # fmt: skip
    assert isinstance(made.profiler, SimpleProfiler) and has(made, ModelSummary)  # type: ignore[attr-defined]
    assert (made.max_steps, made.min_epochs, made.num_sanity_val_steps) == (5, 2, 1)  # type: ignore[attr-defined]
    assert made.limit_train_batches == 1  # type: ignore[attr-defined]


def test_ddp_on_request(tmp_path: Path) -> None:
    assert isinstance(trainer(tmp_path, "trainer.strategy=ddp").strategy, DDPStrategy)
    assert not isinstance(trainer(tmp_path).strategy, DDPStrategy)


@pytest.mark.parametrize(
    "override",
    ["+trainer.limit_train_batches=-1", "+trainer.max_time=soon", "+trainer.profiler=detailed"],
)
def test_what_lightning_refuses_is_a_user_error(tmp_path: Path, override: str) -> None:
    with pytest.raises(UserError, match="trainer: "):
        trainer(tmp_path, override)


def test_a_fused_optimizer_cannot_clip_in_mixed_precision(tmp_path: Path) -> None:
    clip = ["+trainer.gradient_clip_val=1.0", "trainer.precision=bf16-mixed"]
    with pytest.raises(UserError, match=r"trainer\.gradient_clip_val: got 1\.0"):
        trainer(tmp_path, *clip)
    assert trainer(tmp_path, *clip, "model.optimizer.fused=false").gradient_clip_val == 1.0
