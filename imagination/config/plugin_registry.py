"""Plugins: folders in plugins/ and installed distributions with code and a conf tree.

`python -m imagination.plugins` lists them with the options they add; `check=true` also imports their code.
"""

import logging
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml

from imagination.utils.code_hash import GROUP

log = logging.getLogger(__name__)


@dataclass
class Plugin:
    """Discovered plugin.

    Attributes:
        name: name of the folder or entry point.
        origin: description of the location, for messages.
        root: folder on the import path; None for an installed distribution.
        conf: conf tree; None if it is missing.
        packages: names of the importable packages.
        options: config options that the plugin adds, e.g. "data/scenes/rooms".
        problem: reason why the plugin is ignored; empty for a valid plugin.
    """

    name: str
    origin: str
    root: Path | None = None
    conf: Path | None = None
    packages: list[str] = field(default_factory=list)
    options: list[str] = field(default_factory=list)
    problem: str = ""


def core_conf() -> Path:
    """Return the conf tree of the core: inside the installed package, or next to the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def options_of(conf: Path) -> list[str]:
    """Return the config options of a conf tree, e.g. "data/scenes/rooms" for data/scenes/rooms.yaml."""
    return sorted(path.relative_to(conf).with_suffix("").as_posix() for path in conf.rglob("*.yaml"))


def discover() -> list[Plugin]:
    """Find all plugins, folders first, without running their code; `problem` is set for invalid ones."""
    plugins = [*_folders(), *_distributions()]
    names: dict[str, str] = {}
    owners = dict.fromkeys(options_of(core_conf()), "the core")
    for plugin in plugins:
        if not plugin.problem:
            plugin.problem = _examine(plugin, names, owners)
        if not plugin.problem:
            names[plugin.name] = plugin.origin
            owners |= dict.fromkeys(plugin.options, plugin.origin)
    return plugins


def activate() -> list[Plugin]:
    """Make valid plugins importable and return them."""
    valid = [plugin for plugin in discover() if not plugin.problem]
    for plugin in valid:
        if plugin.root is not None and str(plugin.root) not in sys.path:
            sys.path.append(str(plugin.root))
    return valid


def provided(group: str) -> Iterator[tuple[str, str, str]]:
    """Yield plugin, file name and `_target_` of the configs that valid plugins add to a group.

    A file without a `_target_` is skipped with a warning.
    """
    for plugin in activate():
        assert plugin.conf is not None
        for path in sorted((plugin.conf / group).glob("*.yaml")):
            for target in targets_of(yaml.safe_load(path.read_text())):
                yield plugin.name, path.stem, target
                break
            else:
                log.warning(
                    "%s: got no _target_, expected one; %r of the plugin %s is ignored",
                    path,
                    path.stem,
                    plugin.name,
                )


def _folders() -> Iterator[Plugin]:
    """Yield the folders plugins/*/ of the current directory and of the checkout."""
    parents = dict.fromkeys([Path.cwd() / "plugins", core_conf().parent / "plugins"])
    for parent in parents:
        for root in sorted(parent.glob("[!._]*/")):
            packages = sorted(path.parent.name for path in root.glob("*/__init__.py"))
            yield Plugin(root.name, f"folder {root}", root, root / "conf", packages)


def _distributions() -> Iterator[Plugin]:
    """Yield the installed distributions with an entry point in `GROUP`."""
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        version = f"{point.dist.name} {point.dist.version}" if point.dist else "unknown"
        plugin = Plugin(point.name, f"distribution {version}", packages=[point.value.partition(".")[0]])
        try:
            plugin.conf = _conf_of(point)
        except (ImportError, ValueError) as error:
            plugin.problem = str(error)
        yield plugin


def _conf_of(point: EntryPoint) -> Path:
    """Return the folder of an entry point's conf package, without importing the package."""
    package, _, rest = point.value.partition(".")
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(
            f"entry point: got {point.value!r}, but there is no package {package!r}; install it again"
        )
    return Path(spec.submodule_search_locations[0], *rest.split("."))


def _examine(plugin: Plugin, names: Mapping[str, str], owners: Mapping[str, str]) -> str:
    """Set the options of a plugin; return the problem, or an empty string."""
    if plugin.name in names:
        return f"its name is also the name of the plugin in {names[plugin.name]}; rename one of them"
    if plugin.conf is None or not (options := options_of(plugin.conf)):
        return f"no config found in {plugin.conf}; a plugin adds *.yaml files there"
    for option in options:
        if option in owners:  # Hydra would silently use the first one
            return f"its config {option!r} exists already in {owners[option]}; rename it"
        try:
            yaml.safe_load((plugin.conf / f"{option}.yaml").read_text())
        except Exception as error:  # yaml raises any type of exception on malformed dates and numbers
            return f"{option}.yaml cannot be read: {' '.join(str(error).split())}"
    plugin.options = options
    return ""


def targets_of(node: Any) -> Iterator[str]:
    """Yield each `_target_` in a config."""
    if isinstance(node, dict):
        if isinstance(target := node.get("_target_"), str):
            yield target
        for child in node.values():
            yield from targets_of(child)
    elif isinstance(node, list):
        for child in node:
            yield from targets_of(child)
