"""Checks before and during training: accelerator, number of processes, GPU memory."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from imagination.utils.errors import UserError
from imagination.utils.precision import resolved
from imagination.utils.process_group import started_by_torchrun


@contextmanager
def out_of_memory_reported(config: DictConfig) -> Iterator[None]:
    """Raise a UserError with advice if the GPU runs out of memory.

    Raises:
        UserError: if the memory of the GPU is too small.
    """
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        parts = config.data.micro_batches
        views = config.data.batch_size // (config.trainer.devices * config.trainer.num_nodes)
        advice = ["a GPU without other processes"]
        if resolved(config.trainer.precision) == "32-true":
            advice.insert(0, "trainer.precision=bf16-mixed, which needs less memory")
        if parts < views:
            override = f"data.micro_batches={min(2 * parts, views)}"
            advice.insert(0, f"{override}, which splits the batch (and its normalisation) into more parts")
        raise UserError(
            f"GPU memory: training with {views} views per GPU in {parts} part(s) does not fit; start a new run with "
            f"{', or '.join(advice)}. PyTorch reported: {str(error).partition(' Including')[0]}"
        ) from error


def check_processes(config: DictConfig) -> None:
    """Check that the training can be split among its processes and that these are started correctly.

    Raises:
        UserError: if a size is not a multiple of the number of processes, a process would have no scene or no view,
            srun starts independent processes, several hosts are used without torchrun, or a sweep uses several
            processes.
    """
    count = config.trainer.devices * config.trainer.num_nodes
    # set by srun, but not in the batch script of a job
    tasks = int(os.environ.get("SLURM_STEP_NUM_TASKS", 1))
    if tasks > 1 and not started_by_torchrun():
        raise UserError(
            f"srun: got {tasks} tasks, expected 1, because the tasks would train independently; use --ntasks=1, or one "
            "torchrun per host: srun --ntasks-per-node=1 torchrun … (see docs/how-to/scale-out.md)"
        )
    if config.trainer.num_nodes > 1 and not started_by_torchrun():
        raise UserError(
            f"trainer.num_nodes: got {config.trainer.num_nodes} without torchrun, expected 1; start torchrun on each "
            "host (see docs/how-to/scale-out.md)"
        )
    if count == 1:
        return
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        raise UserError(
            f"trainer.devices: got {count} processes in a sweep, expected 1; set trainer.devices=1, or start each job "
            "of the sweep as a run"
        )
    for key in ("data.parallel_scenes", "data.batch_size", "callbacks.replay_buffer.size"):
        if (size := OmegaConf.select(config, key)) % count:
            raise UserError(
                f"{key}: got {size} for {count} processes, expected a multiple of {count}; change {key} or "
                "trainer.devices"
            )
    for key in ("data.splits.train", "data.eval_views.val", "data.eval_views.test"):
        if (size := OmegaConf.select(config, key)) < count:
            raise UserError(
                f"{key}: got {size} for {count} processes, expected at least {count}; raise {key} or lower "
                "trainer.devices"
            )


def check_accelerator(name: str) -> None:
    """Check that this machine has the accelerator of the trainer.

    Raises:
        UserError: if the accelerator is not available.
    """
    from lightning.pytorch.accelerators import AcceleratorRegistry

    classes = {key: AcceleratorRegistry[key]["accelerator"] for key in AcceleratorRegistry}
    available = {key for key, accelerator in classes.items() if accelerator.is_available()}
    available |= {"auto", *(["gpu"] if available & {"cuda", "mps"} else [])}
    if name not in available:
        raise UserError(
            f"trainer.accelerator: got {name!r}, expected one of: {', '.join(sorted(available))}; auto uses a GPU if "
            "PyTorch detects one"
        )
