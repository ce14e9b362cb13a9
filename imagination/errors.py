"""Errors that a user can act on: each names the value got, what is allowed and what to do."""

from collections.abc import Iterable


class UserError(ValueError):
    """A mistake in what the user gave; the commands print its message without a traceback."""


def check_range(
    name: str, value: float, low: float, high: float, unit: str = "", *, open_low: bool = False
) -> float:
    """Return `value` if it is finite and in [low, high] (in (low, high] with `open_low`).

    Raises:
        UserError: with the name, the value got and the range allowed.
    """
    inside = low < value <= high if open_low else low <= value <= high
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
