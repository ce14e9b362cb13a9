"""Roles of the places of a configuration: what a configuration from a run folder, from anyone, may instantiate there.

At each place only classes of its role are instantiated, from the project, its plugins and the libraries below.
"""

import inspect
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
import yaml
from omegaconf import DictConfig, OmegaConf

from imagination.config.plugin_registry import activate
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
    ("data.module.replay", "imagination.data.replay_buffer.ReplaySettings"),
    # model and its training
    ("model.module", "lightning.LightningModule"),
    ("model.unit", "imagination.models.unit.Unit"),
    ("model.unit.unit", "imagination.models.unit.Unit"),
    ("model.collate", "imagination.data.collate.Collate"),
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

SPECIAL_KEYS = ("_target_", "_convert_", "_partial_")
"""Allowed keys of Hydra's instantiation; `_args_` would hide the names of arguments."""

TARGET = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+")
"""Pattern of a dotted name without private parts."""


def check_targets(config: DictConfig) -> None:
    """Check that each place of a config from a file instantiates only classes of its role.

    Raises:
        UserError: if a `_target_` is not allowed at its place or cannot be found, or a node has other special keys.
    """
    values: Any = OmegaConf.to_container(config)
    plugins = activate()
    packages = ("imagination", *LIBRARIES, *(package for plugin in plugins for package in plugin.packages))
    named = {item for plugin in plugins for item in texts_of(plugin.conf)}
    for place, node in nodes(values):
        _check_special_keys(place, node)
        if "_target_" in node and (f"{place}._target_", str(node["_target_"])) not in named:
            _check_role(place, str(node["_target_"]), packages)


def nodes(value: Any, place: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the mappings in plain values with their dotted keys."""
    if isinstance(value, dict):
        yield place, value
    for key, child in children(value):
        yield from nodes(child, f"{place}.{key}".lstrip("."))


def children(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the children of a mapping or a list with their keys or indices."""
    if isinstance(value, dict):
        yield from ((str(key), child) for key, child in value.items())
    if isinstance(value, list):
        yield from ((str(index), child) for index, child in enumerate(value))


def texts_of(conf: Path | None) -> Iterator[tuple[str, str]]:
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
