"""Refuse keys and groups that do not exist, with the closest names."""

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from fnmatch import fnmatch
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig, OmegaConf

from imagination.config.overrides import override_key
from imagination.config.plugin_registry import activate, core_conf, options_of
from imagination.config.search_path import hydra_initialized
from imagination.utils.errors import UserError

TABLES = (
    "categories",
    "categories.*",
    "categories.*.aliases",
    "callbacks",
    "logger",
    "evaluation.approaches",
)
"""Patterns of the nodes to which a user adds rows under names of their choice."""

NO_KEY = re.compile(r"Could not override '([^']+)'")
"""Message of Hydra about a key or a group that does not exist."""

NO_OPTION = re.compile(r"Could not (?:find|load) '(.+)/([^'/]+)'")
"""Message of Hydra about an option that does not exist."""


@contextmanager
def unknown_keys_reported(config_name: str) -> Iterator[None]:
    """Raise a UserError with the closest names if an override names a key, group or option that does not exist.

    Args:
        config_name: name of the command.

    Raises:
        UserError: if a key, a group or an option does not exist.
    """
    try:
        yield
    except ValueError as error:
        if "Config group override must be" in str(error):  # Hydra's message does not name the group
            raise UserError(
                "null: got null for a group, expected the name of an option; only logger=null is possible, and "
                "logger=[] in a sweep"
            ) from error
        raise
    except ConfigCompositionException as error:
        if match := NO_KEY.search(str(error)):
            raise _unknown(config_name, match[1], _names(config_name)) from error
        match = NO_OPTION.search(str(error))
        if match and not match[1].startswith("hydra/") and (options := _options(match[1])):
            raise UserError(
                f"{match[1]}: got {match[2]!r}, which is no option of this group; expected one of: "
                f"{', '.join(options)}{_did_you_mean(get_close_matches(match[2], options))}"
            ) from error
        raise


def check_added_keys(config_name: str, overrides: Sequence[str]) -> None:
    """Check that `+key=value` adds an argument of a `_target_` or a row of a table, and no misspelt key.

    Args:
        config_name: name of the command.
        overrides: overrides of a job.

    Raises:
        UserError: if an added key belongs to nothing, with the closest names.
    """
    added = [text for text in overrides if text.startswith("+") and not is_group(override_key(text))]
    if not added:
        return
    config = hydra.compose(config_name, [text for text in overrides if text not in added])
    keys = [override_key(text) for text in added]
    rows = tuple(key.removesuffix("_target_") for key in keys if key.endswith("._target_"))  # whole new nodes
    for key in (key for key in keys if not key.startswith(rows) or key.endswith("._target_")):
        if OmegaConf.select(config, key, throw_on_missing=False) is None:
            _check_added(config_name, config, key)


def is_group(name: str) -> bool:
    """Return whether a config group has this name, which may hold a package as in `model/loss@node`."""
    return bool(_options(name.partition("@")[0]))


def _options(group: str) -> list[str]:
    """Return the options of a config group."""
    with hydra_initialized():
        return GlobalHydra.instance().config_loader().get_group_options(group, ObjectType.CONFIG)


def _check_added(config_name: str, config: DictConfig, key: str) -> None:
    parent, _, name = key.removesuffix("._target_").rpartition(".")
    if key.startswith("hydra.") or any(fnmatch(parent, pattern) for pattern in TABLES):
        return
    node = OmegaConf.select(config, parent) if parent else config
    if not isinstance(node, DictConfig):
        raise _unknown(config_name, key, _names(config_name))
    if "_target_" in node:
        if (arguments := _arguments(node._target_)) is not None and name not in arguments:
            names = [f"{parent}.{argument}" for argument in arguments if not argument.startswith("_")]
            raise _unknown(config_name, key, names)
    elif not _is_argument(config, parent):
        raise _unknown(config_name, key, _names(config_name))


def _is_argument(config: DictConfig, key: str) -> bool:
    """Return whether a node is part of an argument of a `_target_`, whose content is a matter of the class."""
    parents = key.split(".")
    nodes = (OmegaConf.select(config, ".".join(parents[:count])) for count in range(1, len(parents)))
    return any(isinstance(node, DictConfig) and "_target_" in node for node in nodes)


def _arguments(target: str) -> list[str] | None:
    """Return the names of a target's arguments; None if it accepts any."""
    parameters = inspect.signature(hydra.utils.get_object(target)).parameters
    if any(parameter.kind == parameter.VAR_KEYWORD for parameter in parameters.values()):
        return None
    return [*parameters, "_convert_", "_recursive_", "_partial_"]


def _names(config_name: str) -> list[str]:
    """Return the names of all keys and groups of a command."""
    trees = [core_conf(), *(plugin.conf for plugin in activate() if plugin.conf)]
    groups = {option.rpartition("/")[0] for tree in trees for option in options_of(tree)}
    with hydra_initialized():
        config = hydra.compose(config_name)
    return [*_keys(OmegaConf.to_container(config)), *sorted(groups - {""})]


def _keys(node: Any, prefix: str = "") -> Iterator[str]:
    for name, value in node.items() if isinstance(node, Mapping) else ():
        if not str(name).startswith("_"):
            yield f"{prefix}{name}"
            yield from _keys(value, f"{prefix}{name}.")


def _unknown(config_name: str, key: str, names: Iterable[str]) -> UserError:
    """Return the error for an unknown key, with the closest names of keys and groups."""
    names = list(dict.fromkeys(names))
    leaf = key.rpartition(".")[2]
    same_leaf = [name for name in names if name.rpartition(".")[2] == leaf]  # at another place
    closest = list(dict.fromkeys([*get_close_matches(key, names, n=3, cutoff=0.6), *same_leaf]))[:4]
    return UserError(
        f"{key}: got a key or group that imagination.{config_name} does not have, expected one of "
        f"docs/reference/configuration.md{_did_you_mean(closest)}"
    )


def _did_you_mean(closest: Sequence[str]) -> str:
    return f"; did you mean {', '.join(closest)}?" if closest else ""
