"""Errors that the user can correct: each message gives the value, what is allowed and what to do."""

from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from typing import Any


class UserError(ValueError):
    """Invalid user input; the commands print the message without a traceback."""


class CannotWriteError(UserError):
    """Full disk or read-only folder, where further writes would fail as well."""


class WorkerDiedError(UserError):
    """Worker process that crashed or was killed, possibly out of memory."""


def first_of(names: Sequence[str], limit: int = 5) -> str:
    """Return the first names for a message, and the number of the others."""
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def install_command(extra: str) -> str:
    """Return the command that installs an extra of this project, in its checkout."""
    return f"pip install -e '.[{extra}]'"


def require_extra(package: str, extra: str) -> None:
    """Check that an optional package is installed.

    Raises:
        UserError: if it is missing, with the command that installs it.
    """
    if find_spec(package) is None:
        raise UserError(
            f"{package}: not installed; in the checkout run {install_command(extra)} (with a wheel: "
            f"pip install 'FILE.whl[{extra}]')"
        )


def check_range(
    name: str, value: Any, low: float, high: float, unit: str = "", *, open_low: bool = False
) -> float:
    """Return `value` if it is a finite number in [low, high] (in (low, high] with `open_low`).

    Raises:
        UserError: if it is not, with the name, the value and the allowed range.
    """
    try:
        inside = low < value <= high if open_low else low <= value <= high
    except TypeError:  # text or None
        inside = False
    if not inside:  # also for NaN, which compares false
        bracket = "(" if open_low else "["
        suffix = f" {unit}" if unit else ""
        raise UserError(f"{name}: got {value}, expected a number in {bracket}{low}, {high}]{suffix}")
    number: float = value
    return number


def check_choice(name: str, value: str, allowed: Iterable[str]) -> str:
    """Return `value` if it is among `allowed`.

    Raises:
        UserError: if it is not, with the name, the value and the choices.
    """
    choices = sorted(allowed)
    if value not in choices:
        raise UserError(f"{name}: got {value!r}, expected one of: {', '.join(choices) or '(none exist)'}")
    return value
