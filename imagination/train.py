"""Train a unit and evaluate it: `python -m imagination.train +experiment=chair_unet`."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from imagination.config.contracts import check_contracts
from imagination.runs.command import command
from imagination.runs.final_record import write_final_record
from imagination.runs.folder import best_checkpoint
from imagination.runs.logging import quiet_lightning
from imagination.runs.preflight import check_accelerator, check_processes, out_of_memory_reported
from imagination.runs.resume import Run, open_run
from imagination.runs.run_summary import summary, write_single_view_scores
from imagination.utils.errors import UserError
from imagination.utils.provenance import git_commit
from imagination.utils.timing import stage

if TYPE_CHECKING:
    from lightning import Trainer

    from imagination.data.datamodule import SceneData
    from imagination.models.lit_task import LitTask

log = logging.getLogger(__name__)


@command("train")
def main(config: DictConfig) -> float | None:
    """Train and evaluate; return `optimized_metric`, which a search maximises."""
    if not config.train and not (config.resume or config.ckpt_path):
        raise UserError(
            "train: got false for a new run, expected true; evaluate an existing run with resume=<run folder> "
            "train=false, or a checkpoint with python -m imagination.evaluate ckpt=…"
        )
    git_commit()  # read before files are edited
    with open_run(config) as run:
        log.info("Run folder: %s", run.folder)
        task, trainer, metrics = train(run)
        if trainer.is_global_zero:
            if run.config.test:
                log.info("%s", write_single_view_scores(run.folder, task, metrics))
            log.info("%s", summary(run, best_checkpoint(run.folder)))
        if not run.config.train:
            return None
        from imagination.runs.trainer import optimized_score  # imports torch, which errors before do without

        score = optimized_score(trainer, metrics, run.config.optimized_metric)
        if trainer.is_global_zero:
            epochs = {"epochs": trainer.current_epoch, "max_epochs": run.config.trainer.max_epochs}
            write_final_record(run.folder, score=score, **epochs)
        return score


def train(run: Run) -> tuple[LitTask, Trainer, dict[str, float]]:
    """Build task, data and trainer, train the network, and test its best checkpoint on the test scenes.

    `train=false` and `test=false` leave out the training and the test.

    Returns:
        the task, the trainer, and the last logged metrics of training, validation and test.
    """
    from imagination.reporting.hyperparameters import record_hyperparameters
    from imagination.runs.trainer import log_loggers

    task, data, trainer = build(run)
    log_loggers(trainer)
    metrics: dict[str, float] = {}
    try:
        if run.config.train:
            with stage("scenes and ground truth"):
                data.setup("fit")
            with stage("training"), out_of_memory_reported(run.config):
                trainer.fit(task, datamodule=data, ckpt_path=run.checkpoint, weights_only=True)
            metrics |= {name: float(value) for name, value in trainer.callback_metrics.items()}
        if run.config.test:
            with stage("scenes and ground truth"):
                data.setup("test")
            with stage("evaluation"):
                trainer.test(
                    task,
                    datamodule=data,
                    ckpt_path=best_checkpoint(run.folder),
                    verbose=False,
                    weights_only=True,
                )
    finally:
        data.close()
    if trainer.is_global_zero:
        record_hyperparameters(trainer, run.config)
    metrics |= {name: float(value) for name, value in trainer.callback_metrics.items()}
    return task, trainer, metrics


def build(run: Run) -> tuple[LitTask, SceneData, Trainer]:
    """Build the task, the data and the trainer with its callbacks and loggers."""
    import torch.utils.deterministic
    from hydra.utils import instantiate
    from lightning import seed_everything

    from imagination.runs.checkpoint import check_readable, hyperparameters, read_state
    from imagination.runs.trainer import make_trainer

    config = run.config
    check_accelerator(config.trainer.accelerator)
    check_processes(config)
    check_contracts(config)
    first_step = read_state(run.checkpoint)["global_step"] if run.checkpoint else 0
    quiet_lightning()
    seed_everything(config.seed, verbose=False)
    # deterministic mode fills uninitialized memory to expose reads before writes, which only costs time here
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    task = instantiate(config.model.module)
    saved = hyperparameters(config)
    check_readable(saved)
    task.save_hyperparameters(saved, logger=False)  # for load_from_checkpoint
    return task, instantiate(config.data.module), make_trainer(config, first_step)


if __name__ == "__main__":
    main()
