"""How processes of distributed training start, agree on a run folder and notice that another ended.

Lightning starts the others from the first (`trainer.devices=4`), or torchrun starts all of them on every host. Rank 0
writes the run folder; sizes in the config are those of all processes together.
"""

from __future__ import annotations

import os
import time
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from imagination.utils.process_group import global_rank, started_by_torchrun

if TYPE_CHECKING:
    from lightning.fabric.plugins.environments.cluster_environment import ClusterEnvironment
    from lightning.pytorch.strategies import Strategy

FOLDER = "IMAGINATION_RUN"
"""Environment variable that holds the run's folder for processes started from the first."""


def agree(folder: Path | None = None) -> Path:
    """The run's folder: the first process names it, the others learn it and wait until then."""
    if started_by_torchrun():  # its agent keeps a store for all
        from torch.distributed.rendezvous import rendezvous

        store, _, _ = next(iter(rendezvous("env://")))
        if folder is not None:
            store.set(FOLDER, str(folder))
        return Path(store.get(FOLDER).decode())
    if folder is not None:
        os.environ[FOLDER] = str(folder)
    return Path(os.environ[FOLDER])


def end_with_starter() -> None:
    """Wait until the process that started this one is gone, then end: it may be waiting for it, for a day."""
    starter = os.getppid()
    while os.getppid() == starter:
        time.sleep(1)
    time.sleep(5)  # for the message, where training finds out by itself
    os._exit(1)


def lost_another(error: BaseException) -> bool:
    """Whether an error says that another of the processes is gone."""
    from torch import distributed

    told = str(error).lower()
    kinds = (distributed.DistBackendError, distributed.DistNetworkError)
    return isinstance(error, kinds) or ("gloo" in told and "connection" in told)


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
    chosen.set_global_rank(global_rank())  # until then who logs goes by SLURM_PROCID
    return chosen
