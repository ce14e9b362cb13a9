"""Hyperparameters of a run for its loggers: what was chosen, what identifies the run, and the final scores."""

from collections.abc import Mapping
from typing import Any

from lightning import Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import DictConfig, OmegaConf

from imagination.config.overrides import leaves, override_key
from imagination.evaluation.single_views import ranked_by

MAIN = (
    *("name", "seed", "unit_categories", "model.unit", "model.encoder.name", "model.network.name"),
    *("model.backbone", "model.loss", "model.optimizer.lr", "trainer.max_epochs", "data.batch_size"),
    *("ego.resolution", "aggregation_factor", "mapping.registration"),
)
"""Keys that are shown for every run, as far as its config has them."""


def record_hyperparameters(trainer: Trainer, config: DictConfig) -> None:
    """Write the hyperparameters of a run to its loggers; TensorBoard's HParams tab shows the final scores with them."""
    shown = logged_hyperparameters(config)
    scores = final_scores(trainer.callback_metrics, list(config.evaluation.approaches))
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            _write_hparams(logger, shown, scores)
        else:
            logger.log_hyperparams(shown)
            logger.save()


def logged_hyperparameters(config: DictConfig) -> dict[str, Any]:
    """Return the values of `MAIN` and of the run's overrides by dotted key; a node with a `_target_` by its class."""
    values = dict(leaves(OmegaConf.to_container(config, resolve=True)))  # type: ignore[arg-type]
    chosen = {override_key(text): text.partition("=")[2] for text in config.choices}
    shown = {key: values.get(key, chosen.get(key)) for key in dict.fromkeys([*MAIN, *chosen])}
    return {
        key: str(value) if isinstance(value, list) else value
        for key, value in shown.items()
        if value is not None
    }


def final_scores(metrics: Mapping[str, Any], approaches: list[str]) -> dict[str, float]:
    """Return the IoU of single views of test scenes, and of the global maps of the approach that a run is about."""
    evaluated = [name for name in approaches if any(f"/{name}/" in tag for tag in metrics)]
    approach = ranked_by(evaluated) if evaluated else ""
    return {
        tag: float(value)
        for tag, value in metrics.items()
        if tag == "test/iou"
        or (tag.startswith("global/") and f"/{approach}/" in tag and not tag.endswith("/val"))
    }


def _write_hparams(logger: TensorBoardLogger, shown: Mapping[str, Any], scores: Mapping[str, float]) -> None:
    """Write both into the events of a run; `log_hyperparams` would log the scores a second time."""
    from torch.utils.tensorboard import SummaryWriter
    from torch.utils.tensorboard.summary import hparams

    with SummaryWriter(logger.log_dir) as writer:
        for event in hparams(shown, scores):  # type: ignore[no-untyped-call]
            writer.file_writer.add_summary(event)
