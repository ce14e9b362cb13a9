"""Validation of a composed configuration before objects are instantiated."""

import re
import warnings
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from imagination.config.key_roles import CELL_WIDTH, RANGES
from imagination.geometry.grid import cells_of
from imagination.utils.errors import UserError, check_choice, check_range
from imagination.utils.precision import PRECISIONS


def validate(config: DictConfig) -> None:
    """Check the values of a configuration.

    Raises:
        UserError: on the first invalid value, with its key and what is allowed.
    """
    check_name(config.name)
    for key, bounds in RANGES.items():
        if OmegaConf.select(config, key.partition(".")[0]) is not None:  # not all commands have a trainer
            _check_number(key, OmegaConf.select(config, key), *bounds)
    for key in ("scale.precision", "trainer.precision", "evaluation.precision"):
        if OmegaConf.select(config, key.partition(".")[0]) is not None:
            check_choice(key, OmegaConf.select(config, key), PRECISIONS)
    if not isinstance(config.scale.tta_hflip, bool):
        raise UserError(f"scale.tta_hflip: got {config.scale.tta_hflip!r}, expected true or false")
    epochs = [config.scale[name] for name in ("epochs", "hrnet_epochs", "hrnet_max_epochs")]
    if OmegaConf.select(config, "model.predicts") == "images" and epochs != sorted(epochs):
        raise UserError(
            f"scale.hrnet_epochs: got {epochs[1]}, expected scale.epochs, {epochs[0]}, to scale.hrnet_max_epochs, "
            f"{epochs[2]}, so that the baseline trains at least as long as the units"
        )
    widths = config.scale.cell_widths
    if not isinstance(widths, ListConfig) or not widths:
        raise UserError(f"scale.cell_widths: got {widths!r}, expected a list of metres such as [3.0, 2.5]")
    for width in widths:
        _check_number("scale.cell_widths", width, *CELL_WIDTH)
    for extent in (config.scale.ego_extent, config.scale.world_extent):
        cells_of(extent, config.scale.resolution)
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


def _check_number(key: str, value: Any, low: float, high: float, unit: str) -> None:
    whole = isinstance(low, int)
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        kind = "whole number" if whole else "number"
        raise UserError(f"{key}: got {value!r}, expected a {kind} in [{low}, {high}] {unit}".rstrip())
    check_range(key, value, low, high, unit)


def check_name(name: str) -> str:
    """Return the name of an experiment if it is a valid folder name.

    Raises:
        UserError: if it is invalid or reserved.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.+-]*", name) or name in ("default", "cache", "latest"):
        raise UserError(
            f"name: got {name!r}, expected letters, digits and _ . + - (and not default, cache or latest)"
        )
    return name
