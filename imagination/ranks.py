"""Processes that train together: which one this is, what part of the work is its own, what the first tells the others.

Lightning starts the others from the first (`trainer.devices=4`), or torchrun starts all of them on every host. Number 0
writes the run's folder; sizes in the config are those of all of them together.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:  # torch takes seconds to import: --help does without
    from torch import Tensor

T = TypeVar("T")

FOLDER = "IMAGINATION_RUN"
"""Environment variable that holds the run's folder for processes started from the first."""


def rank() -> int:
    """Number of this process among those that train together."""
    return int(os.environ.get("RANK", os.environ.get("LOCAL_RANK", 0)))


def started_by_torchrun() -> bool:
    """Whether torchrun started this process; else it is the only one, or Lightning starts the others."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def ranks() -> int:
    """How many processes train together; 1 before they have met."""
    from torch import distributed

    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def sum_over_ranks(counts: Tensor) -> Tensor:
    """The sum of a tensor without gradients over all processes that train together."""
    from torch import distributed

    if ranks() > 1:
        distributed.all_reduce(counts)
    return counts


def begun_elsewhere(items: list[T]) -> list[T]:
    """The items from a start of this process's own: processes that share a cache then do not make the same at once."""
    start = rank() * len(items) // int(os.environ.get("WORLD_SIZE", 1))
    return items[start:] + items[:start]


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
