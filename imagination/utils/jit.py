"""Just-in-time compilation of kernels with Numba: single-threaded, cached on disk."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile a kernel, without the shape checkers that the tests wrap around functions at import."""
    return cast(F, njit(cache=True)(inspect.unwrap(function)))
