"""Arguments of Lightning's Trainer: each is respected or refused by name."""

import inspect
from typing import Any

import lightning
import pytest

from imagination.config.compose import compose
from imagination.config.trainer_keys import LIMITED, RESPECTED, check_trainer
from imagination.config.validation import validate
from imagination.utils.errors import UserError

ARGUMENTS = sorted(set(inspect.signature(lightning.Trainer.__init__).parameters) - {"self"})

REFUSED: dict[str, Any] = {
    "callbacks": [{"_target_": "lightning.pytorch.callbacks.RichProgressBar"}],
    "logger": True,
    "plugins": ["x"],
    "strategy": "fsdp",
    "use_distributed_sampler": True,
    "val_check_interval": 0.5,
    "barebones": True,
    "model_registry": "x/y",
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_each_argument_is_respected_or_refused(name: str) -> None:
    """An argument of a new release of Lightning fails here until it is in one of the tables."""
    assert (name in RESPECTED) != (name in LIMITED)
    check_trainer({name: None})
    if name in LIMITED:
        with pytest.raises(UserError, match=rf"trainer\.{name}: got "):
            check_trainer({name: REFUSED[name]})


def test_the_tables_hold_no_other_names() -> None:
    assert sorted([*RESPECTED, *LIMITED]) == ARGUMENTS


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("trainer.strategy=deepspeed", r"trainer\.strategy: got 'deepspeed', expected auto or ddp"),
        ("+trainer.limit_test_batches=0", r"trainer\.limit_test_batches: got 0"),
        ("trainer.check_val_every_n_epoch=null", r"trainer\.check_val_every_n_epoch: got None"),
    ],
)
def test_arguments_are_checked_before_a_run(override: str, message: str) -> None:
    config = compose("train", ["experiment=chair_unet", "scale=test", override])
    with pytest.raises(UserError, match=message):
        validate(config)
