"""Processes that train together: rank, world size and sums over them."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")


def global_rank() -> int:
    """Number of this process among those that train together."""
    return int(os.environ.get("RANK", os.environ.get("LOCAL_RANK", 0)))


def started_by_torchrun() -> bool:
    """Whether torchrun started this process; else it is the only one, or Lightning starts the others."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def world_size() -> int:
    """How many processes train together; 1 before they have met."""
    from torch import distributed

    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def sum_over_ranks(counts: Tensor) -> Tensor:
    """The sum of a tensor without gradients over all processes that train together."""
    from torch import distributed

    if world_size() > 1:
        distributed.all_reduce(counts)
    return counts


def rotated_by_rank(items: list[T]) -> list[T]:
    """The items from a start of this process's own: processes that share a cache then do not make the same at once."""
    start = global_rank() * len(items) // int(os.environ.get("WORLD_SIZE", 1))
    return items[start:] + items[:start]
