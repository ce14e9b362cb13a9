"""Errors that a user can act on: each names the value got, what is allowed and what to do."""

from collections.abc import Iterable, Sequence
from importlib.util import find_spec


class UserError(ValueError):
    """A mistake in what the user gave; the commands print its message without a traceback."""


class CannotWriteError(UserError):
    """A disk that is full, or a folder that may not be written: whatever else would be written fails as well."""


class WorkerDiedError(UserError):
    """A worker process that was killed, as for want of memory, or crashed."""


def first_of(names: Sequence[str], most: int = 5) -> str:
    """The first few names for a message, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def require_extra(package: str, extra: str) -> None:
    """Check that an optional package is installed.

    Raises:
        UserError: with the command that installs it.
    """
    if find_spec(package) is None:
        raise UserError(f"{package}: is not installed, expected it here; pip install 'imagination[{extra}]'")


def check_range(
    name: str, value: float, low: float, high: float, unit: str = "", *, open_low: bool = False
) -> float:
    """Return `value` if it is finite and in [low, high] (in (low, high] with `open_low`).

    Raises:
        UserError: with the name, the value got and the range allowed.
    """
    try:
        inside = low < value <= high if open_low else low <= value <= high
    except TypeError:  # a config or a file may hold text or nothing
        inside = False
    if not inside:  # NaN compares false, so it is refused too
        bracket = "(" if open_low else "["
        suffix = f" {unit}" if unit else ""
        raise UserError(f"{name}: got {value}, expected a number in {bracket}{low}, {high}]{suffix}")
    return value


def check_choice(name: str, value: str, allowed: Iterable[str]) -> str:
    """Return `value` if it is among `allowed`.

    Raises:
        UserError: with the name, the value got and the choices that exist.
    """
    choices = sorted(allowed)
    if value not in choices:
        raise UserError(f"{name}: got {value!r}, expected one of: {', '.join(choices) or '(none exist)'}")
    return value
