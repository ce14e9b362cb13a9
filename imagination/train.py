"""Train a unit and evaluate it: `python -m imagination.train +experiment=chair_unet`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from imagination.runs.command import command
from imagination.runs.distributed import cluster_environment, strategy
from imagination.runs.folder import BEST
from imagination.runs.logging import quiet_lightning
from imagination.runs.preflight import check_accelerator, check_processes, out_of_memory_reported
from imagination.runs.resume import Run, open_run
from imagination.runs.run_summary import record_hyperparameters, summary, write_single_view_scores
from imagination.utils.precision import resolved
from imagination.utils.timing import stage

if TYPE_CHECKING:
    from lightning import LightningModule, Trainer

    from imagination.data.datamodule import SceneData

log = logging.getLogger(__name__)


@command("train")
def main(config: DictConfig) -> float | None:
    """Train and evaluate; return the best egocentric IoU on validation scenes, which a search maximises."""
    with open_run(config) as run:
        log.info("Run folder: %s\nTensorBoard: tensorboard --logdir %s", run.folder, run.folder.parent)
        trainer = train(run)
        if trainer.is_global_zero:
            log.info("%s\n%s", write_single_view_scores(run, trainer), summary(run, best_checkpoint(run)))
        return best_score(trainer)


def train(run: Run) -> Trainer:
    """Build model, data and trainer, train the model, and test its best checkpoint on the test scenes."""
    model, data, trainer = build(run)
    try:
        with stage("scenes and ground truth"):
            data.setup("fit")
        with stage("training"), out_of_memory_reported(run.config):
            trainer.fit(model, datamodule=data, ckpt_path=run.checkpoint, weights_only=True)
        with stage("scenes and ground truth"):
            data.setup("test")
        with stage("evaluation"):
            trainer.test(
                model, datamodule=data, ckpt_path=best_checkpoint(run), verbose=False, weights_only=True
            )
    finally:
        data.close()
    record_hyperparameters(trainer, run.config)
    return trainer


def build(run: Run) -> tuple[LightningModule, SceneData, Trainer]:
    """Build the model, the data and the trainer with its callbacks and logger."""
    import torch.utils.deterministic
    from hydra.utils import instantiate
    from lightning import seed_everything

    from imagination.runs.checkpoint import CheckpointFiles, ConfigInCheckpoint, read_state

    config = run.config
    check_accelerator(config.trainer.accelerator)
    check_processes(config)
    if "purge_step" in config.logger:  # events after the checkpoint are logged again
        config.logger.purge_step = read_state(run.checkpoint)["global_step"] if run.checkpoint else 0
    quiet_lightning()
    seed_everything(config.seed, verbose=False)
    # deterministic mode fills uninitialized memory to expose reads before writes, which only costs time here
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    model = instantiate(config.model.module)
    data = instantiate(config.data.module)
    # a scale also sets values of callbacks that are not selected, which have no `_target_`
    selected = [node for node in config.callbacks.values() if "_target_" in node]
    callbacks = [ConfigInCheckpoint(config), *map(instantiate, selected)]
    trainer = instantiate(
        config.trainer,
        strategy=strategy(config.trainer.devices * config.trainer.num_nodes),
        precision=resolved(config.trainer.precision),
        # to Lightning, micro-batches are batches
        accumulate_grad_batches=config.trainer.accumulate_grad_batches * config.data.micro_batches,
        callbacks=callbacks,
        logger=instantiate(config.logger),
        plugins=[CheckpointFiles(), cluster_environment()],
    )
    return model, data, trainer


def best_checkpoint(run: Run) -> Path | None:
    """Return the checkpoint with the best validation score; None, the weights in memory, if there is no checkpoint."""
    path = run.folder / BEST
    return path if path.is_file() else None


def best_score(trainer: Trainer) -> float | None:
    """Return the validation score of the best checkpoint; None if there is no checkpoint."""
    scores = [getattr(callback, "best_model_score", None) for callback in trainer.checkpoint_callbacks]
    return next((float(score) for score in scores if score is not None), None)


if __name__ == "__main__":
    main()
