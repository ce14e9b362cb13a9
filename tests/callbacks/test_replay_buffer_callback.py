"""Replay-buffer callback: its settings are those of the data module, and it logs the state of the buffer."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.callbacks.replay_buffer import ReplayBufferCallback
from imagination.config.compose import compose
from imagination.config.validation import validate
from imagination.data.replay_buffer import ReplaySettings
from imagination.runs.composed_config import keep_references
from imagination.utils.errors import UserError
from tests.data.test_batches import fit
from tests.data.test_datamodule import REPLAY, data


def callback(settings: ReplaySettings = REPLAY) -> ReplayBufferCallback:
    return ReplayBufferCallback(**asdict(settings))


@pytest.mark.parametrize(
    ("micro_batches", "arguments", "draws"),
    [(1, {}, 0.75), (3, {}, 0.75), (1, {"limit_train_batches": 2}, 0.5)],
)
def test_the_state_of_the_buffer_is_logged(
    tmp_path: Path, micro_batches: int, arguments: dict[str, Any], draws: float
) -> None:
    views = data(tmp_path, replay=REPLAY, micro_batches=micro_batches)
    trained = fit(views, 2, enable_checkpointing=False, callbacks=[callback()], **arguments)
    logged = {name: float(value) for name, value in trained.trainer.callback_metrics.items()}
    assert logged.pop("data/collecting_seconds") > 0
    # three collections of eight views, in a buffer of 40
    assert logged == pytest.approx(
        {
            "data/collected_views": 24,
            "data/draws_per_view": draws,
            "data/buffer_fill": 0.6,
            "data/view_age": 1.0,
        }
    )


def test_other_settings_than_those_of_the_data_module_are_refused(tmp_path: Path) -> None:
    views = data(tmp_path, replay=REPLAY)
    with pytest.raises(UserError, match="data.module.replay.size: got 40, expected 48"):
        fit(views, 1, enable_checkpointing=False, callbacks=[callback(replace(REPLAY, size=48))])


def config(*overrides: str, command: str = "train") -> DictConfig:
    return compose(command, ["experiment=chair_unet", "scale=test", "paths.run=.", *overrides])


@pytest.mark.parametrize("experiment", ["chair_unet", "segmentation_hrnet"])
def test_the_config_gives_both_the_same_settings(experiment: str) -> None:
    composed = config(f"experiment={experiment}", "callbacks.replay_buffer.size=72")
    settings = instantiate(composed.callbacks.replay_buffer).settings
    assert instantiate(composed.data.module.replay) == settings and settings.size == 72
    keep_references(composed, "trainer.max_epochs")  # as in a resumed run that trains for longer
    OmegaConf.update(composed, "trainer.max_epochs", 99)
    assert instantiate(composed.data.module.replay) == settings


def test_training_without_the_callback_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    composed = config("callbacks=[training_stats]")
    validate(composed)
    with pytest.raises(UserError, match="callbacks.replay_buffer: got none.*add replay_buffer to callbacks"):
        instantiate(composed.data.module).setup("fit")


@pytest.mark.parametrize("override", ["~callbacks.replay_buffer", "callbacks.replay_buffer=null"])
def test_deleted_settings_are_refused(override: str) -> None:
    with pytest.raises(UserError, match="callbacks.replay_buffer: got none"):
        validate(config(override))


def test_an_evaluation_needs_no_callbacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    composed = config("callbacks=[]", command="evaluate")
    validate(composed)
    assert instantiate(composed.data.module).replay is None
