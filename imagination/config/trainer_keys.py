"""Arguments of Lightning's Trainer under `trainer:`; each is respected, or refused before anything is trained."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from imagination.utils.errors import UserError


class Limit(NamedTuple):
    """Allowed values of an argument, besides null, and the advice for all others."""

    allowed: tuple[Any, ...]
    advice: str


RESPECTED = (
    *("accelerator", "devices", "num_nodes", "precision", "sync_batchnorm"),
    *("max_epochs", "min_epochs", "max_steps", "min_steps", "max_time"),
    *("fast_dev_run", "overfit_batches", "limit_train_batches", "limit_val_batches", "limit_test_batches"),
    *("limit_predict_batches", "num_sanity_val_steps", "check_val_every_n_epoch", "log_every_n_steps"),
    *("accumulate_grad_batches", "gradient_clip_val", "gradient_clip_algorithm", "detect_anomaly"),
    *("deterministic", "benchmark", "inference_mode", "profiler", "reload_dataloaders_every_n_epochs"),
    *("enable_checkpointing", "enable_progress_bar", "enable_model_summary", "enable_autolog_hparams"),
    "default_root_dir",
)
"""Arguments that are passed to the Trainer as they are; `precision=auto` selects one for the hardware."""

LIMITED: Mapping[str, Limit] = {
    "callbacks": Limit((), "choose them with callbacks=[default,…] and set callbacks.<name>.<argument>"),
    "logger": Limit((), "choose it with logger=…"),
    "plugins": Limit((), "the plugins write checkpoints atomically and detect torchrun"),
    "strategy": Limit(("auto", "ddp"), "the replay buffer and the losses are divided among processes of DDP"),
    "use_distributed_sampler": Limit((False,), "the data module divides the views among the processes"),
    "val_check_interval": Limit(
        (1.0,), "checkpoints and thresholds are those of whole epochs; set trainer.check_val_every_n_epoch"
    ),
    "barebones": Limit((False,), "callbacks read the logged scores"),
    "model_registry": Limit((), "checkpoints are files in the run folder"),
}
"""Arguments of which only some values are possible."""


def check_trainer(trainer: Mapping[str, Any]) -> None:
    """Check the node `trainer` of a config.

    Raises:
        UserError: if a value is not possible here.
    """
    for key, (allowed, advice) in LIMITED.items():
        if trainer.get(key) is not None and trainer[key] not in allowed:
            expected = f"expected {' or '.join(map(str, allowed))}" if allowed else "expected no value"
            raise UserError(f"trainer.{key}: got {trainer[key]!r}, {expected}; {advice}")
    shortest, longest = trainer.get("min_epochs"), trainer.get("max_epochs")
    if shortest is not None and longest is not None and shortest > longest:
        raise UserError(
            f"trainer.min_epochs: got {shortest}, expected at most trainer.max_epochs, {longest}; set both"
        )
    if trainer.get("limit_test_batches") == 0:  # the final table needs scores
        raise UserError("trainer.limit_test_batches: got 0, expected at least one batch")
