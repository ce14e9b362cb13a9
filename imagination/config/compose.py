"""Compose configurations as the commands do."""

import hydra
from omegaconf import DictConfig

from imagination.config.overrides import normalized
from imagination.config.search_path import hydra_initialized
from imagination.config.unknown_keys import check_added_keys, unknown_keys_reported


def compose(config_name: str, overrides: list[str]) -> DictConfig:
    """Compose a config as a command does, in a script or within another command.

    Raises:
        UserError: if an override names a key or an option that does not exist.
    """
    overrides = normalized(overrides)
    with hydra_initialized(), unknown_keys_reported(config_name):
        check_added_keys(config_name, overrides)
        return hydra.compose(config_name, overrides)
