"""Train a unit and evaluate it: `python -m imagination.train +experiment=chair_unet`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from imagination.runs.command import command
from imagination.runs.final_record import write_final_record
from imagination.runs.folder import BEST
from imagination.runs.logging import quiet_lightning
from imagination.runs.preflight import check_accelerator, check_processes, out_of_memory_reported
from imagination.runs.resume import Run, open_run
from imagination.runs.run_summary import summary, write_single_view_scores
from imagination.utils.timing import stage

if TYPE_CHECKING:
    from lightning import Trainer

    from imagination.data.datamodule import SceneData
    from imagination.models.lit_task import LitTask

log = logging.getLogger(__name__)


@command("train")
def main(config: DictConfig) -> float | None:
    """Train and evaluate; return the best egocentric IoU on validation scenes, which a search maximises."""
    with open_run(config) as run:
        log.info("Run folder: %s", run.folder)
        task, trainer = train(run)
        if trainer.is_global_zero:
            scores = write_single_view_scores(run, trainer, task)
            log.info("%s\n%s", scores, summary(run, best_checkpoint(run)))
            epochs = {"epochs": trainer.current_epoch, "max_epochs": run.config.trainer.max_epochs}
            write_final_record(run.folder, score=best_score(trainer), **epochs)
        return best_score(trainer)


def train(run: Run) -> tuple[LitTask, Trainer]:
    """Build task, data and trainer, train the network, and test its best checkpoint on the test scenes."""
    from imagination.reporting.hyperparameters import record_hyperparameters

    task, data, trainer = build(run)
    log_loggers(trainer)
    try:
        with stage("scenes and ground truth"):
            data.setup("fit")
        with stage("training"), out_of_memory_reported(run.config):
            trainer.fit(task, datamodule=data, ckpt_path=run.checkpoint, weights_only=True)
        with stage("scenes and ground truth"):
            data.setup("test")
        with stage("evaluation"):
            trainer.test(
                task, datamodule=data, ckpt_path=best_checkpoint(run), verbose=False, weights_only=True
            )
    finally:
        data.close()
    if trainer.is_global_zero:
        record_hyperparameters(trainer, run.config)
    return task, trainer


def build(run: Run) -> tuple[LitTask, SceneData, Trainer]:
    """Build the task, the data and the trainer with its callbacks and loggers."""
    import torch.utils.deterministic
    from hydra.utils import instantiate
    from lightning import seed_everything

    from imagination.runs.checkpoint import hyperparameters, read_state
    from imagination.runs.trainer import make_trainer

    config = run.config
    check_accelerator(config.trainer.accelerator)
    check_processes(config)
    first_step = read_state(run.checkpoint)["global_step"] if run.checkpoint else 0
    quiet_lightning()
    seed_everything(config.seed, verbose=False)
    # deterministic mode fills uninitialized memory to expose reads before writes, which only costs time here
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    task = instantiate(config.model.module)
    task.save_hyperparameters(hyperparameters(config), logger=False)  # for load_from_checkpoint
    return task, instantiate(config.data.module), make_trainer(config, first_step)


def log_loggers(trainer: Trainer) -> None:
    """Log where the loggers of a run write."""
    from lightning.pytorch.loggers import TensorBoardLogger

    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            log.info("TensorBoard: tensorboard --logdir %s", logger.root_dir)
        elif folder := logger.log_dir or logger.save_dir:
            log.info("%s: %s", type(logger).__name__, folder)


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
