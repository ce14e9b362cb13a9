"""Findings about the machine and the installation, as `imagination.doctor` prints them."""

from typing import NamedTuple


class Finding(NamedTuple):
    """One thing looked at.

    Attributes:
        name: what.
        good: True, False, or None if it is only missing what not everybody needs.
        told: what was found, and what to do about it.
    """

    name: str
    good: bool | None
    told: str
