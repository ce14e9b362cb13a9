"""Distributed training: rank, world size and reduction over processes."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")


def global_rank() -> int:
    """Return the rank of this process among all training processes."""
    return int(os.environ.get("RANK", os.environ.get("LOCAL_RANK", 0)))


def started_by_torchrun() -> bool:
    """Return whether torchrun started this process; otherwise it is the only one, or Lightning starts the others."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def world_size() -> int:
    """Return the number of training processes; 1 before the process group is initialised."""
    from torch import distributed

    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def sum_over_ranks(counts: Tensor) -> Tensor:
    """Sum a tensor without gradients over all training processes, in place."""
    from torch import distributed

    if world_size() > 1:
        distributed.all_reduce(counts)
    return counts


def rotated_by_rank(items: list[T]) -> list[T]:
    """Rotate items by rank, so that processes with a common cache do not build the same entry at once."""
    start = global_rank() * len(items) // int(os.environ.get("WORLD_SIZE", 1))
    return items[start:] + items[:start]
