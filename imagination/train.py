"""Train a unit and evaluate it: `python -m imagination.train +experiment=chair_unet`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from imagination.runs.command import command
from imagination.runs.distributed import environment, strategy
from imagination.runs.folder import BEST
from imagination.runs.logging import quiet_lightning
from imagination.runs.preflight import check_accelerator, check_shares, gpu_memory
from imagination.runs.resume import Run, opened
from imagination.runs.run_summary import record_hyperparameters, single_views, summary
from imagination.utils.precision import resolved
from imagination.utils.timing import stage

if TYPE_CHECKING:
    from lightning import LightningModule, Trainer

    from imagination.data.datamodule import SceneData

log = logging.getLogger(__name__)


@command("train")
def main(config: DictConfig) -> float | None:
    """The command; a search maximises what it returns, the best egocentric IoU on validation scenes."""
    with opened(config) as run:
        log.info("Run folder: %s\nWatch it: tensorboard --logdir %s", run.folder, run.folder.parent)
        trainer = train(run)
        if trainer.is_global_zero:
            log.info("%s\n%s", single_views(run, trainer), summary(run, best(run)))
        return best_score(trainer)


def train(run: Run) -> Trainer:
    """Build everything that the config names, fit, evaluate on scenes that training never saw."""
    model, data, trainer = build(run)
    try:
        with stage("scenes and truth"):
            data.setup("fit")
        with stage("training"), gpu_memory(run.config):
            trainer.fit(model, datamodule=data, ckpt_path=run.checkpoint, weights_only=True)
        with stage("scenes and truth"):
            data.setup("test")
        with stage("evaluation"):
            trainer.test(model, datamodule=data, ckpt_path=best(run), verbose=False, weights_only=True)
    finally:
        data.close()
    record_hyperparameters(trainer, run.config)
    return trainer


def build(run: Run) -> tuple[LightningModule, SceneData, Trainer]:
    """Model, data and trainer with its callbacks and logger."""
    import torch.utils.deterministic
    from hydra.utils import instantiate
    from lightning import seed_everything

    from imagination.runs.checkpoint import CheckpointFiles, ConfigInCheckpoint, read_state

    config = run.config
    check_accelerator(config.trainer.accelerator)
    check_shares(config)
    if "purge_step" in config.logger:  # what a killed process logged after the checkpoint comes again
        config.logger.purge_step = read_state(run.checkpoint)["global_step"] if run.checkpoint else 0
    quiet_lightning()
    seed_everything(config.seed, verbose=False)
    # deterministic algorithms fill whatever they allocate, to find out who reads it before it is written
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    model = instantiate(config.model.module)
    data = instantiate(config.data.module)
    callbacks = [ConfigInCheckpoint(config), *(instantiate(node) for node in config.callbacks.values())]
    trainer = instantiate(
        config.trainer,
        strategy=strategy(config.trainer.devices * config.trainer.num_nodes),
        precision=resolved(config.trainer.precision),
        callbacks=callbacks,
        logger=instantiate(config.logger),
        plugins=[CheckpointFiles(), environment()],
    )
    return model, data, trainer


def best(run: Run) -> Path | None:
    """The checkpoint to evaluate: the best one on validation scenes; None, the weights in memory, if none was kept."""
    path = run.folder / BEST
    return path if path.is_file() else None


def best_score(trainer: Trainer) -> float | None:
    """Of the checkpoint that was evaluated; None if none was kept."""
    scores = [getattr(callback, "best_model_score", None) for callback in trainer.checkpoint_callbacks]
    return next((float(score) for score in scores if score is not None), None)


if __name__ == "__main__":
    main()
