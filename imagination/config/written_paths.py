"""Limits of the paths to which the objects of a configuration from a run folder, from anyone, write files."""

import inspect
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imagination.config.plugin_registry import activate, core_conf
from imagination.config.references import REFERENCE
from imagination.config.trust import children, nodes, texts_of
from imagination.utils.errors import UserError

WRITERS = ("trainer", "callbacks", "logger")
"""Nodes of objects that write files to the paths among their arguments."""

WRITTEN = ("data.module.shard_cache",)
"""Further values that are paths to which files are written."""

FETCHED = ("data.shards", "data.module.shards")
"""Values that may be URLs: what lies there decides which files litdata writes."""

PATH_NAME = re.compile(r"(.*_)?(dir|dirs|dirpath|path|paths|folder|file|root|location|uri)(_.*)?")
"""Pattern of the names of arguments that are paths."""

PATH_VALUE = re.compile(r"[/~\\].*|(.*[/\\])?\.\.([/\\].*)?|[A-Za-z][\w+.-]*:/.*", re.DOTALL)
"""Pattern of texts that lead out of a folder: an absolute path, one with "..", or a URL."""


def check_paths(config: DictConfig, command: DictConfig) -> None:
    """Check that the objects of a config from a file write inside the run folder or the cache only.

    Args:
        config: config from the file, with `paths` of the command.
        command: config of the command, whose paths are trusted.

    Raises:
        UserError: if a path is elsewhere, and neither the command nor the installed conf has it there.
    """
    folders = [Path(config.paths[name]) for name in ("run", "cache")]
    installed = {
        item for conf in (core_conf(), *(each.conf for each in activate())) for item in texts_of(conf)
    }
    for place, text in _written(OmegaConf.to_container(config, resolve=True)):
        inside = any(_is_inside(text, folder) for folder in folders)
        if not (inside or _is_installed(place, config, installed) or text in _texts(_at(command, place))):
            raise UserError(
                f"{place}: got {text!r}, expected a path in the run folder or in paths.cache; "
                f"if you trust it, repeat the overrides that set {place}"
            )


def _is_installed(place: str, config: DictConfig, installed: set[tuple[str, str]]) -> bool:
    """Return whether the installed conf has the same text at a place, with references to `paths` only."""
    node: Any = OmegaConf.to_container(config)
    for key in place.split("."):
        node = dict(children(node)).get(key)
    keys = [key for _, key in REFERENCE.findall(node)] if isinstance(node, str) else []
    return (place, str(node)) in installed and all(key.startswith("paths.") for key in keys)


def _written(values: Any) -> Iterator[tuple[str, str]]:
    """Yield the places and texts of the paths and URLs in plain values that decide where files are written."""
    for parent, node in nodes(values):
        for key, child in children(node):
            place = f"{parent}.{key}"
            for text in _texts(child):
                writer = place.partition(".")[0] in WRITERS
                fetched = place in FETCHED and "://" in text
                if (
                    place in WRITTEN
                    or fetched
                    or (writer and (PATH_VALUE.fullmatch(text) or _is_path(node, key)))
                ):
                    yield place, text


def _is_path(node: dict[str, Any], key: str) -> bool:
    """Return whether an argument is a path by its name or its annotation."""
    if PATH_NAME.fullmatch(key) or "_target_" not in node:
        return PATH_NAME.fullmatch(key) is not None
    parameters = inspect.signature(hydra.utils.get_object(node["_target_"])).parameters
    return key in parameters and "Path" in str(parameters[key].annotation)


def _is_inside(text: str, folder: Path) -> bool:
    try:
        return Path(text).resolve().is_relative_to(folder.resolve())
    except (ValueError, RuntimeError, OSError):  # a null byte, a circle of links, a name that is too long
        return False


def _texts(value: Any) -> list[str]:
    """Return a text or, of a list, all its texts."""
    if isinstance(value, list):
        return [text for item in value for text in _texts(item)]
    return [value] if isinstance(value, str) else []


def _at(config: DictConfig, place: str) -> Any:
    """Return the plain value at a dotted key; None if there is none."""
    with suppress(OmegaConfBaseException):
        value = OmegaConf.select(config, place)
        return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
    return None
