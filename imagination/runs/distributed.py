"""Distributed training: start of the processes, their common run folder, and detection of lost processes.

Rank 0 starts the other processes through Lightning (`trainer.devices=4`), or torchrun starts all of them on every
host. Rank 0 writes the run folder. Sizes in the config, such as the batch size, are totals over all processes.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from imagination.utils import interrupts
from imagination.utils.process_group import global_rank, started_by_torchrun

if TYPE_CHECKING:
    from lightning import Trainer
    from lightning.fabric.plugins.environments.cluster_environment import ClusterEnvironment

FOLDER_KEY = "IMAGINATION_RUN"
"""Environment variable, or key in torchrun's store, that holds the run folder."""


def share_run_folder(folder: Path | None = None) -> Path:
    """Return the run folder, which rank 0 passes and the other ranks wait for."""
    if started_by_torchrun():  # torchrun's agent holds a key-value store for all ranks
        from torch.distributed.rendezvous import rendezvous

        store, _, _ = next(iter(rendezvous("env://")))
        if folder is not None:
            store.set(FOLDER_KEY, str(folder))
        return Path(store.get(FOLDER_KEY).decode())
    if folder is not None:
        os.environ[FOLDER_KEY] = str(folder)
    return Path(os.environ[FOLDER_KEY])


def stop_job_at_once() -> None:
    """End this process when a signal arrives, and pass the signal on to rank 0, which prints the message.

    Lightning kills rank 0 after another of its processes has failed, so this one exits with 0.
    """

    parent = os.getppid()

    def stop(number: int) -> None:
        if started_by_torchrun():  # its agent stops the other processes
            os._exit(128 + number)
        if os.getppid() == parent:
            os.kill(parent, number)
        os._exit(0)

    interrupts.hold()
    interrupts.react_at_once(stop)


def pass_signals_on(trainer: Trainer) -> None:
    """Pass a signal on to the other processes at once, also while they wait for this one.

    Lightning's handler of SIGTERM is not used: it starts a collective operation, which never ends if the processes
    are in another one.
    """
    setattr(trainer._signal_connector, "register_signal_handlers", lambda: None)  # noqa: B010
    launcher = trainer.strategy.launcher
    if trainer.world_size > 1 and launcher is not None and trainer.is_global_zero:
        interrupts.react_at_once(launcher.kill)


def exit_with_parent() -> None:
    """End this process after its parent has ended; a collective operation would wait for the parent for a day."""
    parent = os.getppid()
    while os.getppid() == parent:
        time.sleep(1)
    time.sleep(5)  # time for an error message, if the training itself detects the loss
    os._exit(1)


def is_process_lost(error: BaseException) -> bool:
    """Return whether an error means that another training process has ended."""
    from torch import distributed

    message = str(error).lower()
    kinds = (distributed.DistBackendError, distributed.DistNetworkError)
    return isinstance(error, kinds) or ("gloo" in message and "connection" in message)


def cluster_environment() -> ClusterEnvironment:
    """Return the cluster environment of torchrun or of Lightning, depending on which one started the processes.

    It is set explicitly because Lightning would take every process in a SLURM allocation for one rank of a job and
    log on rank 0 only.
    """
    from lightning.fabric.plugins.environments.lightning import LightningEnvironment
    from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment

    environment = TorchElasticEnvironment() if started_by_torchrun() else LightningEnvironment()
    environment.set_global_rank(global_rank())  # otherwise SLURM_PROCID decides which process logs
    return environment
