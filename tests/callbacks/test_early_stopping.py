"""Early stopping on given scores."""

from typing import Any

import pytest
import torch
from lightning import LightningModule, Trainer

from imagination.callbacks.early_stopping import EarlyStopping
from imagination.utils.errors import UserError


class FakeTrainer(Trainer):
    """Trainer with the attributes that the callback reads, without training."""

    callback_metrics: dict[str, torch.Tensor] = {}
    current_epoch = 0
    should_stop = False

    def __init__(self) -> None:
        self.callback_metrics = {}


MODULE = LightningModule()


def callback(**changes: Any) -> EarlyStopping:
    settings = {"patience": 2, "min_delta": 0.01, "min_epochs": 1}
    return EarlyStopping("val/iou", **(settings | changes))


def play(stopping: EarlyStopping, fake: FakeTrainer, scores: list[float]) -> int:
    """Return the number of scores before training ended."""
    for number, score in enumerate(scores, start=1):
        fake.callback_metrics["val/iou"] = torch.tensor(score)
        stopping.on_validation_end(fake, MODULE)
        fake.current_epoch += 1
        if fake.should_stop:
            return number
    return len(scores)


def test_training_ends_when_the_score_stays_flat() -> None:
    # .205 exceeds .2 by less than min_delta, .3 by more; the next two scores do not exceed .3
    assert play(callback(), FakeTrainer(), [0.1, 0.2, 0.205, 0.3, 0.305, 0.2, 0.9]) == 6


def test_training_lasts_at_least_as_long_as_its_schedule() -> None:
    assert play(callback(min_epochs=8), FakeTrainer(), [0.1] * 20) == 8


def test_ending_before_the_schedule_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    """This happens with trainer.max_epochs below hrnet.epochs, flat or not."""
    stopping, fake = callback(min_epochs=8), FakeTrainer()
    play(stopping, fake, [0.1] * 7)  # trainer.max_epochs
    stopping.on_train_end(fake, MODULE)
    assert stopping.flat and "ended after 7 epochs" in caplog.text and "8 epochs" in caplog.text
    caplog.clear()
    play(stopping, fake, [0.1])
    stopping.on_train_end(fake, MODULE)
    assert caplog.text == ""


def test_a_resumed_training_does_the_same() -> None:
    scores = [0.1, 0.1, 0.2, 0.2, 0.2, 0.2]
    assert play(callback(), FakeTrainer(), scores) == 5
    for cut in range(1, 5):
        first, second = callback(), callback()
        assert play(first, FakeTrainer(), scores[:cut]) == cut
        second.load_state_dict(first.state_dict())
        assert play(second, FakeTrainer(), scores[cut:]) == 5 - cut


def test_a_finished_training_that_is_resumed_ends_at_once() -> None:
    first, fake = callback(), FakeTrainer()
    play(first, fake, [0.1] * 9)
    assert fake.should_stop
    again, other = callback(), FakeTrainer()
    again.load_state_dict(first.state_dict())
    other.current_epoch = fake.current_epoch
    again.on_train_start(other, MODULE)
    assert other.should_stop


def test_values_out_of_range_are_refused() -> None:
    with pytest.raises(UserError, match=r"early_stopping\.min_delta: got -0.1"):
        callback(min_delta=-0.1)
    with pytest.raises(UserError, match=r"early_stopping\.patience: got 0"):
        callback(patience=0)
