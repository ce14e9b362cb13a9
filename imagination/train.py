"""Train a unit and evaluate it: `python -m imagination.train +experiment=chair_unet`."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from imagination import runs
from imagination.config import command
from imagination.errors import UserError
from imagination.precision import resolved
from imagination.progress import stage
from imagination.ranks import rank, started_by_torchrun
from imagination.resume import Run, opened
from imagination.summary import record_hyperparameters, single_views, summary

if TYPE_CHECKING:  # torch and lightning take seconds to import: --help does without
    from lightning import LightningModule, Trainer
    from lightning.fabric.plugins.environments.cluster_environment import ClusterEnvironment
    from lightning.pytorch.strategies import Strategy

    from imagination.data.datamodule import SceneData

log = logging.getLogger(__name__)


@command("train")
def main(config: DictConfig) -> float | None:
    """The command; a search maximises what it returns, the best egocentric IoU on validation homes."""
    with opened(config) as run:
        log.info("Run folder: %s\nWatch it: tensorboard --logdir %s", run.folder, run.folder.parent)
        trainer = train(run)
        if trainer.is_global_zero:
            log.info("%s\n%s", single_views(run, trainer), summary(run, best(run)))
        return best_score(trainer)


def train(run: Run) -> Trainer:
    """Build everything that the config names, fit, evaluate on homes that training never saw."""
    model, data, trainer = build(run)
    try:
        with stage("homes and truth"):
            data.setup("fit")
        with stage("training"), gpu_memory(run.config):
            trainer.fit(model, datamodule=data, ckpt_path=run.checkpoint, weights_only=True)
        with stage("homes and truth"):
            data.setup("test")
        with stage("evaluation"):
            trainer.test(model, datamodule=data, ckpt_path=best(run), verbose=False, weights_only=True)
    finally:
        data.close()
    record_hyperparameters(trainer, run.config)
    return trainer


@contextmanager
def gpu_memory(config: DictConfig) -> Iterator[None]:
    """Tell a GPU that is too small for training.

    Raises:
        UserError: if its memory does not suffice.
    """
    import torch

    from imagination.callbacks.replay_buffer import PARTS

    try:
        yield
    except torch.OutOfMemoryError as error:
        parts = config.trainer.accumulate_grad_batches
        share = config.scale.batch_size // (config.trainer.devices * config.trainer.num_nodes)
        advice = ["a GPU that nobody else uses"]
        if resolved(config.trainer.precision) == "32-true":
            advice.insert(0, "scale.precision=bf16-mixed, which takes less")
        if parts < share:
            more = f"{PARTS[config.model.predicts]}={min(2 * parts, share)}"
            advice.insert(0, f"{more}, which computes the batch in more parts (as does batch normalisation)")
        raise UserError(
            f"GPU memory: training with {share} views a GPU in {parts} part(s) does not fit; expected a new run with "
            f"{', or '.join(advice)}. It said: {str(error).partition(' Including')[0]}"
        ) from error


def build(run: Run) -> tuple[LightningModule, SceneData, Trainer]:
    """Model, data and trainer with its callbacks and logger."""
    import torch.utils.deterministic
    from hydra.utils import instantiate
    from lightning import seed_everything

    from imagination.checkpoints import CheckpointFiles, ConfigInCheckpoint, read_state

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


def check_shares(config: DictConfig) -> None:
    """Check that the work can be shared out among the processes that train together.

    Raises:
        UserError: if a size is not a multiple of their number, some would have nothing to do, or a sweep, srun or
            nobody would start them.
    """
    count = config.trainer.devices * config.trainer.num_nodes
    # of an srun; a batch script, which runs once, has none
    tasks = int(os.environ.get("SLURM_STEP_NUM_TASKS", 1))
    if tasks > 1 and not started_by_torchrun():
        raise UserError(
            f"srun: got {tasks} tasks, which would train apart from each other; expected one (--ntasks=1), or "
            "torchrun as one task a host, which starts those that train together: srun --ntasks-per-node=1 torchrun … "
            "(see docs/scaling.md)"
        )
    if config.trainer.num_nodes > 1 and not started_by_torchrun():
        raise UserError(
            f"trainer.num_nodes: got {config.trainer.num_nodes} without torchrun, which would wait for the others for "
            "ever; expected 1, or torchrun on each host (see docs/scaling.md)"
        )
    if count == 1:
        return
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        raise UserError(
            f"trainer.devices: got {count} processes in a sweep, whose members train on one device each; start each "
            "member by itself, or sweep with trainer.devices=1"
        )
    sizes = {name: config.scale[name] for name in ("parallel_scenes", "batch_size", "buffer_size")}
    for name, size in sizes.items():
        if size % count:
            raise UserError(
                f"scale.{name}: got {size} for {count} processes, expected a multiple of {count}; change it or "
                "trainer.devices"
            )
    least = {"homes.train": "home", "held_out_views.val": "view", "held_out_views.test": "view"}
    for name, kind in least.items():
        if (got := OmegaConf.select(config.scale, name)) < count:
            raise UserError(f"scale.{name}: got {got} for {count} processes, expected a {kind} for each")


def strategy(processes: int) -> Strategy | str:
    """How processes train together: Lightning's DDP, whose others wait while the first one evaluates."""
    from lightning.pytorch.strategies import DDPStrategy

    return DDPStrategy(timeout=timedelta(days=1)) if processes > 1 else "auto"


def environment() -> ClusterEnvironment:
    """Who started the processes: torchrun or Lightning itself.

    Told, since Lightning would take any process in a SLURM allocation for one of several and let the first alone log.
    """
    from lightning.fabric.plugins.environments.lightning import LightningEnvironment
    from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment

    chosen = TorchElasticEnvironment() if started_by_torchrun() else LightningEnvironment()
    chosen.set_global_rank(rank())  # until then who logs goes by SLURM_PROCID
    return chosen


def quiet_lightning() -> None:
    """Leave out what Lightning tells about itself; its warnings stay."""
    for name in ("lightning.pytorch", "lightning.fabric.utilities.distributed"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"lightning\.")
    warnings.filterwarnings(
        "ignore", message="Checkpoint directory .* exists and is not empty"
    )  # as it should on resume
    # it is not to be used: see check_shares
    warnings.filterwarnings("ignore", message="The `srun` command is available")
    # batches are ready-made
    warnings.filterwarnings("ignore", message=".*does not have many workers")
    warnings.filterwarnings("ignore", message=".*sync_dist=True.*")  # these values are the same on all ranks


def check_accelerator(asked: str) -> None:
    """Check that this machine has the accelerator that the trainer is to use.

    Raises:
        UserError: if it has not.
    """
    from lightning.pytorch.accelerators import AcceleratorRegistry

    known = {name: AcceleratorRegistry[name]["accelerator"] for name in AcceleratorRegistry}
    usable = {name for name, accelerator in known.items() if accelerator.is_available()}
    usable |= {"auto", *(["gpu"] if usable & {"cuda", "mps"} else [])}
    if asked not in usable:
        raise UserError(
            f"trainer.accelerator: got {asked!r}, expected one that this machine has: {', '.join(sorted(usable))}; "
            "auto takes a GPU where PyTorch sees one"
        )


def best(run: Run) -> Path | None:
    """The checkpoint to evaluate: the best one on validation homes; None, the weights in memory, if none was kept."""
    path = run.folder / runs.BEST
    return path if path.is_file() else None


def best_score(trainer: Trainer) -> float | None:
    """Of the checkpoint that was evaluated; None if none was kept."""
    scores = [getattr(callback, "best_model_score", None) for callback in trainer.checkpoint_callbacks]
    return next((float(score) for score in scores if score is not None), None)


if __name__ == "__main__":
    main()
