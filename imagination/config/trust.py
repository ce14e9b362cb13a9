"""Limits of a configuration from a run folder, which may come from anyone: its classes, and the paths it writes to.

Each place of the configuration has a role, and only classes of that role are instantiated there, from the project, its
plugins and the libraries below. Objects that write files get paths inside the run folder or the cache only.
"""

import inspect
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import hydra
import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imagination.config.plugin_registry import activate, core_conf
from imagination.config.references import REFERENCE
from imagination.utils.errors import UserError

ROLES: tuple[tuple[str, str], ...] = (
    # robot, maps and scenes
    ("camera", "imagination.geometry.camera.Camera.from_degrees"),
    ("sensor", "imagination.scenes.sensor.Sensor"),
    ("ego", "imagination.geometry.grid.EgoGrid.of_extent"),
    ("obstacles", "imagination.geometry.projection.Band"),
    ("ground_truth", "imagination.ground_truth.scene_maps.GroundTruthSpec"),
    ("ground_truth.camera", "imagination.geometry.camera.Camera.from_degrees"),
    ("cache", "imagination.utils.cache.Cache"),
    # data
    ("data.table", "imagination.scenes.categories.CategoryTable.from_config"),
    ("data.scenes", "imagination.scenes.source.SceneSource"),
    ("data.furniture", "imagination.scenes.building_blocks.furniture_source.Furniture"),
    ("data.sampler", "imagination.views.collector.PoseSampler"),
    ("data.observer", "imagination.views.observer.Observer"),
    ("data.module", "imagination.data.datamodule.SceneData"),
    ("data.module.eval_sampler", "imagination.views.collector.PoseSampler"),
    # model and its training
    ("model.module", "lightning.LightningModule"),
    ("model.unit", "imagination.models.unit.Unit"),
    ("model.unit.unit", "imagination.models.unit.Unit"),
    ("model.encoder", "torch.nn.Module"),
    ("model.backbone", "torch.nn.Module"),
    ("model.network", "torch.nn.Module"),
    ("model.loss", "imagination.models.losses.Loss"),
    ("model.loss", "torch.nn.Module"),
    ("model.optimizer", "torch.optim.Optimizer"),
    ("model.scheduler", "torch.optim.lr_scheduler.LRScheduler"),
    ("trainer", "lightning.Trainer"),
    ("trainer.profiler", "lightning.pytorch.profilers.Profiler"),
    ("callbacks.*", "lightning.Callback"),
    ("logger", "lightning.pytorch.loggers.Logger"),
    ("logger.*", "lightning.pytorch.loggers.Logger"),
    # maps and their evaluation
    ("mapping.registration", "imagination.mapping.update_rules.UpdateRule"),
    ("evaluation", "imagination.evaluation.protocol.MappingProtocol"),
    ("evaluation.approaches.*", "imagination.evaluation.approaches.Approach"),
    ("evaluation.approaches.*.evidence", "imagination.evaluation.approaches.EvidenceSource"),
    ("evaluation.approaches.*.rule", "imagination.mapping.update_rules.UpdateRule"),
)
"""Places of the config (* is any key), and the class or protocol of what is instantiated there.

A classmethod stands for itself. A plugin may instantiate more inside its objects: what its own conf tree names there.
"""

LIBRARIES = ("lightning.pytorch", "torch.nn", "torch.optim", "torchmetrics")
"""Packages whose classes may be instantiated, in addition to those of the project and its plugins."""

REPLACED = {
    "lightning.pytorch.callbacks.ModelCheckpoint": "imagination.callbacks.model_checkpoint.MovableCheckpoint"
}
"""Classes that delete files named in a checkpoint, and the subclass that deletes only in its folder."""

PARTIAL = ("model.backbone", "model.network", "model.optimizer", "model.scheduler")
"""Places where `_partial_` is allowed."""

WRITERS = ("trainer", "callbacks", "logger")
"""Nodes of objects that write files to the paths among their arguments."""

WRITTEN = ("data.module.shard_cache",)
"""Further values that are paths to which files are written."""

SPECIAL_KEYS = ("_target_", "_convert_", "_partial_")
"""Allowed keys of Hydra's instantiation; `_args_` would hide the names of arguments."""

TARGET = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+")
"""Pattern of a dotted name without private parts."""

PATH_NAME = re.compile(r"(.*_)?(dir|dirs|dirpath|path|paths|folder|file|root|location|uri)(_.*)?")
"""Pattern of the names of arguments that are paths."""

PATH_VALUE = re.compile(r"[/~\\].*|(.*[/\\])?\.\.([/\\].*)?|[A-Za-z][\w+.-]*:/.*", re.DOTALL)
"""Pattern of texts that lead out of a folder: an absolute path, one with "..", or a URL."""


def check_targets(config: DictConfig) -> None:
    """Check that each place of a config from a file instantiates only classes of its role.

    Raises:
        UserError: if a `_target_` is not allowed at its place or cannot be found, or a node has other special keys.
    """
    values: Any = OmegaConf.to_container(config)
    plugins = activate()
    packages = ("imagination", *LIBRARIES, *(package for plugin in plugins for package in plugin.packages))
    named = {item for plugin in plugins for item in _texts_of(plugin.conf)}
    for place, node in nodes(values):
        _check_special_keys(place, node)
        if "_target_" in node and (f"{place}._target_", node["_target_"]) not in named:
            _check_role(place, str(node["_target_"]), packages)


def check_paths(config: DictConfig, command: DictConfig) -> None:
    """Check that the objects of a config from a file write inside the run folder or the cache only.

    Args:
        config: config from the file, with `paths` of the command.
        command: config of the command, whose paths are trusted.

    Raises:
        UserError: if a path is elsewhere, and neither the one of the command nor one that the installed conf sets there.
    """
    folders = [Path(config.paths[name]) for name in ("run", "cache")]
    installed = {
        item for conf in (core_conf(), *(each.conf for each in activate())) for item in _texts_of(conf)
    }
    for place, text in _written(OmegaConf.to_container(config, resolve=True)):
        inside = any(_is_inside(text, folder) for folder in folders)
        if not (inside or _is_installed(place, config, installed) or text in _texts(_at(command, place))):
            raise UserError(
                f"{place}: got {text!r}, expected a path in the run folder or in paths.cache; "
                f"if you trust it, repeat {place}=… on the command line"
            )


def _is_installed(place: str, config: DictConfig, installed: set[tuple[str, str]]) -> bool:
    """Return whether the installed conf has the same text at a place, with references to `paths` only."""
    node: Any = OmegaConf.to_container(config)
    for key in place.split("."):
        node = dict(_children(node)).get(key)
    keys = [key for _, key in REFERENCE.findall(node)] if isinstance(node, str) else []
    return (place, str(node)) in installed and all(key.startswith("paths.") for key in keys)


def _written(values: Any) -> Iterator[tuple[str, str]]:
    """Yield the places and texts of the paths in plain values to which files are written."""
    for parent, node in nodes(values):
        for key, child in _children(node):
            place = f"{parent}.{key}"
            for text in _texts(child):
                writer = place.partition(".")[0] in WRITERS
                if place in WRITTEN or (writer and (PATH_VALUE.fullmatch(text) or _is_path(node, key))):
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


def nodes(value: Any, place: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the mappings in plain values with their dotted keys."""
    if isinstance(value, dict):
        yield place, value
    for key, child in _children(value):
        yield from nodes(child, f"{place}.{key}".lstrip("."))


def _children(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        yield from ((str(key), child) for key, child in value.items())
    if isinstance(value, list):
        yield from ((str(index), child) for index, child in enumerate(value))


def _texts_of(conf: Path | None) -> Iterator[tuple[str, str]]:
    """Yield the place and the value of each text in a conf tree."""
    assert conf is not None, "the core and valid plugins have a conf tree"
    for path in conf.rglob("*.yaml"):
        text = path.read_text()
        package = re.search(r"^#\s*@package\s+(\S+)", text, re.MULTILINE)
        top = package[1] if package else ".".join(path.parent.relative_to(conf).parts)
        for place, node in nodes(yaml.safe_load(text), "" if top == "_global_" else top):
            for key, value in node.items():
                if isinstance(value, str):
                    yield f"{place}.{key}", value


def _check_special_keys(place: str, node: dict[str, Any]) -> None:
    special = [key for key in map(str, node) if re.fullmatch("_.*_", key)]
    allowed = [key for key in SPECIAL_KEYS if key != "_partial_" or place in PARTIAL]
    if refused := [key for key in special if key not in allowed]:
        raise UserError(f"{place}: got the key {refused[0]!r}, expected arguments; start a new run")


def _check_role(place: str, target: str, packages: Sequence[str]) -> None:
    bases = [base for pattern, base in ROLES if _matches(place, pattern)]
    if not bases:
        raise UserError(
            f"{place}: got the _target_ {target!r}, expected plain values; if you trust it, start a new run with it"
        )
    if target in bases:
        return
    cls = _class_of(target, packages)
    if cls is None or not any(_has_role(cls, base) for base in bases):
        raise UserError(
            f"{place}: got the _target_ {target!r}, expected {' or '.join(bases)}, or a class of that kind in the "
            f"project, its plugins or {', '.join(LIBRARIES)}; if you trust it, start a new run with it"
        )
    for base, subclass in REPLACED.items():
        if _has_role(cls, base) and not _has_role(cls, subclass):
            raise UserError(
                f"{place}: got the _target_ {target!r}, expected {subclass}; start a new run with it"
            )


def _class_of(target: str, packages: Sequence[str]) -> type | None:
    """Return the class of a dotted name; None if it is no class, or not defined in one of the packages.

    Raises:
        UserError: if it cannot be imported.
    """
    tops = {package.partition(".")[0] for package in packages}
    if not TARGET.fullmatch(target) or target.partition(".")[0] not in tops:
        return None
    try:
        cls = hydra.utils.get_object(target)
    except (ImportError, AttributeError) as error:
        raise UserError(f"_target_: got {target!r}, which cannot be imported; install its plugin") from error
    # the module that defines the class decides, not the path that imports it
    if not inspect.isclass(cls) or not f"{cls.__module__}.".startswith(
        tuple(f"{name}." for name in packages)
    ):
        return None
    return cls


def _has_role(cls: type, name: str) -> bool:
    """Return whether a class is a subclass of the named class, or has the methods of the named protocol."""
    base = hydra.utils.get_object(name)
    if not inspect.isclass(base):  # a classmethod, which stands for itself
        return False
    if not getattr(base, "_is_protocol", False):
        return issubclass(cls, base)
    methods = [each for each, value in vars(base).items() if inspect.isfunction(value) and _is_public(each)]
    return all(_arguments(getattr(cls, each, None)) == _arguments(vars(base)[each]) for each in methods)


def _is_public(method: str) -> bool:
    return method == "__call__" or not method.startswith("_")


def _arguments(method: Any) -> list[str] | None:
    return list(inspect.signature(method).parameters) if callable(method) else None


def _matches(place: str, pattern: str) -> bool:
    """Return whether a dotted key matches a pattern in which * stands for any key."""
    return re.fullmatch(re.escape(pattern).replace(r"\*", r"[^.]+"), place) is not None
