"""Plugins: folders under plugins/ and installed distributions that bring code and a conf tree.

`python -m imagination.plugins` lists them with what each adds; `check=true` imports their code as well.
"""

import importlib
import logging
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml

log = logging.getLogger(__name__)

GROUP = "imagination.plugins"
"""Entry-point group: the name is the plugin's, the value its conf package, e.g. "imagination_rooms.conf"."""


@dataclass
class Plugin:
    """One plugin as found.

    Attributes:
        name: of its folder or entry point.
        origin: where it was found, for people.
        root: folder its packages are imported from; None if they are installed.
        conf: its conf tree; None if it has none.
        packages: names of its importable packages.
        options: config options it adds, e.g. "data/scenes/rooms".
        problem: why it is left out; empty if it is not.
    """

    name: str
    origin: str
    root: Path | None = None
    conf: Path | None = None
    packages: list[str] = field(default_factory=list)
    options: list[str] = field(default_factory=list)
    problem: str = ""


def core_conf() -> Path:
    """The core's conf tree: inside the package where it was installed, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def options_of(conf: Path) -> list[str]:
    """Config options of a conf tree, e.g. "data/scenes/rooms" for data/scenes/rooms.yaml."""
    return sorted(path.relative_to(conf).with_suffix("").as_posix() for path in conf.rglob("*.yaml"))


def discover() -> list[Plugin]:
    """All plugins, folders first. None of their code runs; one that is broken has its `problem` set."""
    found = [*_folders(), *_distributions()]
    names: dict[str, str] = {}
    owners = dict.fromkeys(options_of(core_conf()), "the core")
    for plugin in found:
        if not plugin.problem:
            plugin.problem = _examine(plugin, names, owners)
        if not plugin.problem:
            names[plugin.name] = plugin.origin
            owners |= dict.fromkeys(plugin.options, plugin.origin)
    return found


def activate() -> list[Plugin]:
    """Make sound plugins importable and return them."""
    sound = [plugin for plugin in discover() if not plugin.problem]
    for plugin in sound:
        if plugin.root is not None and str(plugin.root) not in sys.path:
            sys.path.append(str(plugin.root))
    return sound


def provided(group: str) -> Iterator[tuple[str, str, str]]:
    """What sound plugins put into a folder of their conf trees: plugin, name of the file, its `_target_`.

    A file without one is told and left out.
    """
    for plugin in activate():
        assert plugin.conf is not None
        for path in sorted((plugin.conf / group).glob("*.yaml")):
            for target in targets_of(yaml.safe_load(path.read_text())):
                yield plugin.name, path.stem, target
                break
            else:
                log.warning(
                    "%s: names no _target_, so the plugin %s provides no %s", path, plugin.name, path.stem
                )


def check(plugin: Plugin) -> str:
    """Import a plugin's packages and every `_target_` that its conf names; the problem met, or an empty string."""
    from hydra.utils import get_object

    assert plugin.conf is not None
    try:
        for package in plugin.packages:
            importlib.import_module(package)
        for path in sorted(plugin.conf.rglob("*.yaml")):
            for target in targets_of(yaml.safe_load(path.read_text())):
                get_object(target)
    except Exception as error:  # a stranger's code may raise anything, and the others must still be listed
        return f"{type(error).__name__}: {error}"
    return ""


def _folders() -> Iterator[Plugin]:
    """plugins/*/ of the current directory and of the checkout."""
    places = dict.fromkeys([Path.cwd() / "plugins", core_conf().parent / "plugins"])
    for place in places:
        for root in sorted(place.glob("[!._]*/")):
            packages = sorted(path.parent.name for path in root.glob("*/__init__.py"))
            yield Plugin(root.name, f"folder {root}", root, root / "conf", packages)


def _distributions() -> Iterator[Plugin]:
    """Installed distributions with an entry point in our group."""
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        version = f"{point.dist.name} {point.dist.version}" if point.dist else "unknown"
        plugin = Plugin(point.name, f"distribution {version}", packages=[point.value.partition(".")[0]])
        try:
            plugin.conf = _conf_of(point)
        except (ImportError, ValueError) as error:
            plugin.problem = str(error)
        yield plugin


def _conf_of(point: EntryPoint) -> Path:
    """Folder of an entry point's conf package, found without importing the package."""
    package, _, rest = point.value.partition(".")
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(f"its entry point names {point.value!r}, but there is no package {package!r}")
    return Path(spec.submodule_search_locations[0], *rest.split("."))


def _examine(plugin: Plugin, names: Mapping[str, str], owners: Mapping[str, str]) -> str:
    """Fill in a plugin's options; the reason to leave it out, or an empty string."""
    if plugin.name in names:
        return f"its name is taken by the plugin of {names[plugin.name]}; rename one of them"
    if plugin.conf is None or not (options := options_of(plugin.conf)):
        return f"no config found in {plugin.conf}; a plugin adds *.yaml files there"
    for option in options:
        if option in owners:  # Hydra would silently take the first
            return f"its config {option!r} exists already in {owners[option]}; rename it"
        try:
            yaml.safe_load((plugin.conf / f"{option}.yaml").read_text())
        except Exception as error:  # yaml raises anything on what looks like a date or a number
            return f"{option}.yaml cannot be read: {' '.join(str(error).split())}"
    plugin.options = options
    return ""


def targets_of(node: Any) -> Iterator[str]:
    """Every `_target_` in a config."""
    if isinstance(node, dict):
        if isinstance(target := node.get("_target_"), str):
            yield target
        for child in node.values():
            yield from targets_of(child)
    elif isinstance(node, list):
        for child in node:
            yield from targets_of(child)
