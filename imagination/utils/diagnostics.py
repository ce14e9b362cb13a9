"""Results of the checks of machine and installation that `imagination.doctor` prints."""

from typing import NamedTuple


class Finding(NamedTuple):
    """Result of one check.

    Attributes:
        name: name of the checked item.
        good: True, False, or None if only an optional dependency is missing.
        message: result, with the remedy if there is a problem.
    """

    name: str
    good: bool | None
    message: str
