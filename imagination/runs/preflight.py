"""Checks of the machine before and during training: accelerator, processes, GPU memory."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from imagination.config.key_roles import MICRO_BATCH_KEYS
from imagination.utils.errors import UserError
from imagination.utils.precision import resolved
from imagination.utils.process_group import started_by_torchrun


@contextmanager
def gpu_memory(config: DictConfig) -> Iterator[None]:
    """Tell a GPU that is too small for training.

    Raises:
        UserError: if its memory does not suffice.
    """
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        parts = config.trainer.accumulate_grad_batches
        share = config.scale.batch_size // (config.trainer.devices * config.trainer.num_nodes)
        advice = ["a GPU that nobody else uses"]
        if resolved(config.trainer.precision) == "32-true":
            advice.insert(0, "scale.precision=bf16-mixed, which takes less")
        if parts < share:
            more = f"{MICRO_BATCH_KEYS[config.model.predicts]}={min(2 * parts, share)}"
            advice.insert(0, f"{more}, which computes the batch in more parts (as does batch normalisation)")
        raise UserError(
            f"GPU memory: training with {share} views a GPU in {parts} part(s) does not fit; expected a new run with "
            f"{', or '.join(advice)}. It said: {str(error).partition(' Including')[0]}"
        ) from error


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
    least = {"scenes.train": "scene", "eval_views.val": "view", "eval_views.test": "view"}
    for name, kind in least.items():
        if (got := OmegaConf.select(config.scale, name)) < count:
            raise UserError(f"scale.{name}: got {got} for {count} processes, expected a {kind} for each")


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
