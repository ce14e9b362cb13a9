"""How kernels are compiled: by numba, on one thread, cached on disk beside their module."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile a kernel. Shape checkers that wrap functions at import, as in the tests, are looked through."""
    return cast(F, njit(cache=True)(inspect.unwrap(function)))
