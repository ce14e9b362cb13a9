"""Lightning's Trainer of a run: its callbacks and loggers, and the score of the run."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from datetime import timedelta
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning import Callback, LightningModule, Trainer
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Checkpoint, DeviceStatsMonitor, LearningRateMonitor, ProgressBar
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.strategies import DDPStrategy, Strategy
from omegaconf import DictConfig

from imagination.runs.checkpoint import CheckpointFiles
from imagination.runs.distributed import cluster_environment, pass_signals_on
from imagination.utils import interrupts
from imagination.utils.errors import UserError, require_extra
from imagination.utils.precision import resolved

log = logging.getLogger(__name__)


PACKAGES: Mapping[str, str] = {"WandbLogger": "wandb", "MLFlowLogger": "mlflow"}
"""Package, and extra of the same name, that a logger needs."""


def make_trainer(config: DictConfig, first_step: int) -> Trainer:
    """Return the trainer of a config.

    Args:
        config: composed config of the run.
        first_step: first step that is logged; points of an interrupted process from there on are discarded.

    Raises:
        UserError: if Lightning refuses an argument.
    """
    check_gradient_clipping(config)
    loggers = make_loggers(config.get("logger"), first_step)
    callbacks = make_callbacks(config, loggers)
    try:
        trainer: Trainer = instantiate(
            config.trainer,
            strategy=make_strategy(config.trainer),
            precision=resolved(config.trainer.precision),
            # to Lightning, micro-batches are batches
            accumulate_grad_batches=config.trainer.accumulate_grad_batches * config.data.micro_batches,
            callbacks=[LoggedEpochs(), *callbacks],
            logger=loggers or False,
            plugins=[CheckpointFiles(), cluster_environment()],
        )
    except InstantiationException as error:
        if isinstance(error.__cause__, (MisconfigurationException, TypeError, ValueError)):
            raise UserError(f"trainer: {error.__cause__}; change or remove the argument") from error
        raise
    pass_signals_on(trainer)
    return trainer


def make_strategy(trainer: DictConfig) -> Strategy | str:
    """Return DDP for several processes or on request; its timeout covers an evaluation on rank 0 alone."""
    if trainer.devices * trainer.num_nodes > 1 or trainer.get("strategy") == "ddp":
        return DDPStrategy(timeout=timedelta(days=1))
    return "auto"


def make_loggers(node: DictConfig | None, first_step: int) -> list[Logger]:
    """Return the loggers of the node `logger`: none, one, or several by name."""
    if not node:
        return []
    nodes = [node] if "_target_" in node else [each for each in node.values() if each]
    for each in nodes:
        if package := PACKAGES.get(each._target_.rpartition(".")[2]):
            require_extra(package, package)
        if "purge_step" in each:
            each.purge_step = first_step
    return [instantiate(each) for each in nodes]


def make_callbacks(config: DictConfig, loggers: Sequence[Logger]) -> list[Callback]:
    """Return the callbacks of a config, without those that an argument of the trainer or a missing logger disables."""
    disabled: tuple[Any, ...] = ()
    if config.trainer.get("enable_progress_bar") is False:
        disabled += (ProgressBar,)
    if config.trainer.get("enable_checkpointing") is False:
        disabled += (Checkpoint,)
    if not loggers:  # these raise an error without a logger
        disabled += (LearningRateMonitor, DeviceStatsMonitor)
    # a scale also sets values of callbacks that are not selected, which have no `_target_`
    nodes = [node for node in (config.callbacks or {}).values() if node and "_target_" in node]
    return [callback for callback in map(instantiate, nodes) if not isinstance(callback, disabled)]


def check_gradient_clipping(config: DictConfig) -> None:
    """Check that gradients can be clipped: in mixed precision, Lightning refuses optimisers that unscale themselves.

    Raises:
        UserError: if the optimiser is fused.
    """
    mixed = resolved(config.trainer.precision).endswith("mixed")
    if config.trainer.get("gradient_clip_val") and mixed and config.model.optimizer.get("fused"):
        raise UserError(
            f"trainer.gradient_clip_val: got {config.trainer.gradient_clip_val} in mixed precision with a fused "
            "optimizer, which Lightning cannot clip; set model.optimizer.fused=false"
        )


class LoggedEpochs(Callback):
    """Callback that postpones signals from a checkpoint until the metrics of its epoch are logged.

    Lightning logs them after the checkpoint, from which a resumed run continues with the next epoch.
    """

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        if trainer.training:
            interrupts.hold()

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._release()

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        self._release()

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._release()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        interrupts.release()

    def _release(self) -> None:
        interrupts.release()
        interrupts.check()


def log_loggers(trainer: Trainer) -> None:
    """Log where the loggers of a run write."""
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            log.info("TensorBoard: tensorboard --logdir %s", logger.root_dir)
        elif folder := logger.log_dir or logger.save_dir:
            log.info("%s: %s", type(logger).__name__, folder)


def optimized_score(trainer: Trainer, metrics: Mapping[str, float], metric: str) -> float | None:
    """Return the score that a search maximises; None if there is none.

    Args:
        trainer: trainer after the training.
        metrics: last logged values by name.
        metric: name of the metric. For the metric that the best checkpoint monitors, the score of that checkpoint is
            returned, for others the value that was logged last.
    """
    for callback in trainer.checkpoint_callbacks:
        score = getattr(callback, "best_model_score", None)
        if getattr(callback, "monitor", None) == metric and score is not None:
            return float(score)
    if metric not in metrics:
        log.warning("optimized_metric: got %r, expected one of: %s", metric, ", ".join(sorted(metrics)))
    return metrics.get(metric)
