"""Early stopping of trainings with given scores."""

from pathlib import Path
from typing import Any

import lightning
import pytest

from imagination.callbacks.early_stopping import EarlyStopping
from imagination.utils.errors import UserError
from tests.helpers.scored import Scored, one_batch, quiet_trainer


def callback(**changes: Any) -> EarlyStopping:
    return EarlyStopping("val/iou", **({"patience": 2, "min_delta": 0.01} | changes))


def play(scores: list[float], path: Path | None = None, **options: Any) -> lightning.Trainer:
    """Train with these scores, one validation per epoch, from a checkpoint if there is one."""
    trainer = quiet_trainer(**({"max_epochs": len(scores), "callbacks": [callback()]} | options))
    module = Scored(scores)
    trainer.fit(module, one_batch(), one_batch(), ckpt_path=path, weights_only=True)
    return trainer


def test_training_ends_when_the_score_stays_flat() -> None:
    # .205 exceeds .2 by less than min_delta, .3 by more; the next two scores do not exceed .3
    assert play([0.1, 0.2, 0.205, 0.3, 0.305, 0.2, 0.9]).current_epoch == 6


def test_training_lasts_at_least_min_epochs() -> None:
    assert play([0.1] * 12, min_epochs=8).current_epoch == 8


def test_a_score_that_rises_again_before_min_epochs_is_waited_for() -> None:
    """Lightning's own request to stop, after three epochs, would end the training after five."""
    assert play([0.1, 0.1, 0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4], min_epochs=5).current_epoch == 8


def test_ending_before_the_schedule_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    play([0.1] * 7, min_epochs=8)  # flat, but too short
    assert "ended after 7 epochs" in caplog.text and "trainer.min_epochs, 8" in caplog.text
    caplog.clear()
    play([0.1, 0.2, 0.3])  # not flat
    assert "ended after 3 epochs" in caplog.text
    caplog.clear()
    play([0.1] * 9, min_epochs=8)
    assert "ended after" not in caplog.text


@pytest.mark.parametrize("cut", [1, 2, 3, 4, 6])
def test_a_resumed_training_does_the_same(tmp_path: Path, cut: int) -> None:
    """After six epochs it has ended, so that it ends at once."""
    scores = [0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.9, 0.9]
    assert play(scores, min_epochs=4).current_epoch == 6
    first = play(scores, min_epochs=4, max_epochs=cut)
    first.save_checkpoint(tmp_path / "last.ckpt")
    assert play(scores, tmp_path / "last.ckpt", min_epochs=4).current_epoch == 6


def test_values_out_of_range_are_refused() -> None:
    with pytest.raises(UserError, match=r"early_stopping\.min_delta: got -0.1"):
        callback(min_delta=-0.1)
    with pytest.raises(UserError, match=r"early_stopping\.patience: got 0"):
        callback(patience=0)
