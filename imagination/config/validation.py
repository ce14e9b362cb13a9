"""Validation of a composed configuration before objects are instantiated."""

import re
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from imagination.config.key_roles import KEYS
from imagination.config.trainer_keys import check_trainer
from imagination.utils.errors import UserError, check_choice, check_range
from imagination.utils.precision import PRECISIONS

LISTS = ("evaluation.cell_widths",)
"""Keys whose value is a list of numbers."""


def validate(config: DictConfig) -> None:
    """Check the values of a configuration.

    Raises:
        UserError: on the first invalid value, with its key and what is allowed.
    """
    from imagination.geometry.grid import cells_of  # imports numpy, which --help does not need

    check_name(config.name)
    read = [key for key in KEYS if _is_read(config, key)]
    for key in sorted(read, key=partial(_is_reference, config)):  # values before the references to them
        row = KEYS[key]
        if row.low is not None and row.high is not None:
            for value in _numbers(key, OmegaConf.select(config, key)):
                _check_number(key, value, row.low, row.high, row.unit)
    for key in ("trainer.precision", "evaluation.precision"):
        if _is_read(config, key):
            check_choice(key, OmegaConf.select(config, key), PRECISIONS)
    if not isinstance(config.model.tta_hflip, bool):
        raise UserError(f"model.tta_hflip: got {config.model.tta_hflip!r}, expected true or false")
    _check_baseline(config.hrnet)
    _check_replay_buffer(config)
    for extent in (config.ego.extent, config.world.extent):
        cells_of(extent, config.ego.resolution)
    if OmegaConf.select(config, "trainer") is not None:
        check_trainer(config.trainer)
    if not isinstance(config.unit_categories, ListConfig):
        raise UserError(f"unit_categories: got {config.unit_categories!r}, expected a list such as [chair]")
    if not config.unit_categories:
        raise UserError(
            "unit_categories: got none, expected at least one of: " + ", ".join(config.categories)
        )
    for name in config.unit_categories:
        check_choice("category", name, config.categories)
    if config.kernels.imaginable < config.kernels.neighbourhood:
        warnings.warn(
            f"kernels.imaginable ({config.kernels.imaginable} m) is smaller than kernels.neighbourhood "
            f"({config.kernels.neighbourhood} m): W_gamma then covers label cells outside the imaginable mask",
            stacklevel=2,
        )


def _numbers(key: str, value: Any) -> Sequence[Any]:
    """Return the numbers in a list of metres, or another value alone."""
    if key not in LISTS:
        return [value]
    if not isinstance(value, ListConfig) or not value:
        raise UserError(f"{key}: got {value!r}, expected a list of metres such as [3.0, 2.5]")
    return value


def _is_read(config: DictConfig, key: str) -> bool:
    """Return whether the command, with the options that are selected, reads a key."""
    parent = OmegaConf.select(config, key.rpartition(".")[0]) if "." in key else config
    return parent is not None and key.rpartition(".")[2] in parent


def _is_reference(config: DictConfig, key: str) -> bool:
    parent, _, name = key.rpartition(".")
    return OmegaConf.is_interpolation(OmegaConf.select(config, parent) if parent else config, name)


def _check_baseline(hrnet: DictConfig) -> None:
    """Check that the baseline, which reuses the units' views, trains at least as long as the units."""
    if not hrnet.collection_epochs <= hrnet.epochs <= hrnet.max_epochs:
        raise UserError(
            f"hrnet.epochs: got {hrnet.epochs}, expected hrnet.collection_epochs, {hrnet.collection_epochs}, to "
            f"hrnet.max_epochs, {hrnet.max_epochs}, so that the baseline trains at least as long as the units"
        )


def _check_number(key: str, value: Any, low: float, high: float, unit: str) -> None:
    whole = isinstance(low, int)
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        kind = "whole number" if whole else "number"
        raise UserError(f"{key}: got {value!r}, expected a {kind} in [{low}, {high}] {unit}".rstrip())
    check_range(key, value, low, high, unit)


def _check_replay_buffer(config: DictConfig) -> None:
    """Check that the settings of the replay buffer exist if the data module refers to them."""
    refers = OmegaConf.select(config, "data.module.replay") is not None
    if refers and OmegaConf.select(config, "callbacks.replay_buffer") is None:
        raise UserError(
            "callbacks.replay_buffer: got none, expected the settings of the replay buffer, which data.module.replay "
            "refers to; remove the override that deletes them"
        )


def check_name(name: str) -> str:
    """Return the name of an experiment if it is a valid folder name.

    Raises:
        UserError: if it is invalid or reserved.
    """
    if (
        not isinstance(name, str)
        or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.+-]*", name)
        or name in ("default", "cache", "latest")
    ):
        raise UserError(
            f"name: got {name!r}, expected letters, digits and _ . + - (and not default, cache or latest)"
        )
    return name
