"""Contracts of the classes that plugins add: the methods and attributes that the rest of the program uses."""

import importlib
import inspect
from collections.abc import Iterator
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import hydra
from omegaconf import DictConfig, OmegaConf

from imagination.config.plugin_registry import Plugin
from imagination.config.trust import nodes, texts_of
from imagination.utils.errors import UserError


class Contract(NamedTuple):
    """Methods and attributes of a class that the program uses.

    Attributes:
        name: dotted name of the class or protocol that documents the methods, with their arguments.
        methods: names of the methods.
        attributes: names of the attributes.
    """

    name: str
    methods: tuple[str, ...]
    attributes: tuple[str, ...] = ()


RULE = Contract("imagination.mapping.update_rules.UpdateRule", ("__call__",))

CONTRACTS = {
    "mapping.registration": RULE,
    "evaluation.approaches.*.rule": RULE,
    "model.unit": Contract("imagination.models.unit.Unit", ("forward",), ("categories",)),
    "model.encoder": Contract("imagination.models.encoders.Encoder", ("forward",), ("channels",)),
    "model.backbone": Contract("imagination.models.backbones.Backbone", ("forward",), ("width",)),
    "model.loss": Contract("imagination.models.losses.Loss", ("__call__",), ("in_parts",)),
    "data.scenes": Contract(
        "imagination.scenes.source.SceneSource", ("scenes", "load", "identity", "fingerprint")
    ),
    "sensor": Contract("imagination.scenes.sensor.Sensor", ("__call__",)),
}
"""Contracts by place in the config (* is any key)."""


def check_contracts(config: DictConfig) -> None:
    """Check the objects of plugins in a config before a training; the project's classes have tests.

    Raises:
        UserError: if an object lacks something of its contract.
    """
    values: Any = OmegaConf.to_container(config, resolve=True)
    for place, node in nodes(values):
        target = str(node.get("_target_", ""))
        contract = _contract_of(place)
        if contract is None or not target or target.startswith("imagination."):
            continue
        cls = hydra.utils.get_object(target)
        missing = list(_missing_methods(cls, contract))
        if node.get("_partial_"):  # created later, with further arguments
            missing += _never_assigned(cls, contract)
        elif contract.attributes and not missing:
            missing += _missing_attributes(hydra.utils.instantiate(node), contract)
        if missing:
            raise UserError(f"{place}: got {target}, {_problem(missing, contract)}")


def check_plugin(plugin: Plugin) -> str:
    """Import the packages of a plugin and each `_target_` of its conf tree, and check the contracts of the targets.

    Returns:
        the problem, or an empty string.
    """
    try:
        for package in plugin.packages:
            importlib.import_module(package)
        return plugin_problem(plugin.conf)
    except Exception as error:  # code of a plugin may raise any type of exception
        return f"{type(error).__name__}: {error}"


def plugin_problem(conf: Path | None) -> str:
    """Return the first violation of a contract in a plugin's conf tree, without creating objects; "" if there is none.

    An attribute counts as present if the class has it or a method assigns it to `self`.
    """
    for key, target in texts_of(conf):
        if not key.endswith("._target_"):
            continue
        place, cls = key.removesuffix("._target_"), hydra.utils.get_object(target)
        if (contract := _contract_of(place)) is None:
            continue
        if missing := [*_missing_methods(cls, contract), *_never_assigned(cls, contract)]:
            return f"{place}: got {target}, {_problem(missing, contract)}"
    return ""


def _contract_of(place: str) -> Contract | None:
    return next((contract for pattern, contract in CONTRACTS.items() if fnmatch(place, pattern)), None)


def _problem(missing: list[str], contract: Contract) -> str:
    return f"which lacks {', '.join(missing)} of its contract, expected those of {contract.name}"


def _missing_methods(cls: Any, contract: Contract) -> Iterator[str]:
    """Yield the methods that a class lacks, or that cannot be called with the arguments of the contract."""
    documented = hydra.utils.get_object(contract.name)
    for name in contract.methods:
        _, *arguments = inspect.signature(getattr(documented, name)).parameters  # without self
        # the call of a torch.nn.Module accepts anything and passes it on to `forward`
        own = "forward" if name == "__call__" and hasattr(cls, "forward") else name
        method = inspect.getattr_static(cls, own, None)
        call = f"{name}({', '.join(arguments)})"
        if not callable(method) or name in getattr(cls, "__abstractmethods__", ()):
            yield call
            continue
        try:
            inspect.signature(method).bind(None, *arguments)
        except TypeError:
            yield call


def _missing_attributes(instance: Any, contract: Contract) -> list[str]:
    return [name for name in contract.attributes if not hasattr(instance, name)]


def _never_assigned(cls: Any, contract: Contract) -> Iterator[str]:
    """Yield the attributes that neither a class nor a method of it or of its bases sets."""
    sources = []
    for base in inspect.getmro(cls) if inspect.isclass(cls) else ():
        with suppress(OSError, TypeError):  # a class without Python source
            sources.append(inspect.getsource(base))
    for name in contract.attributes:
        if not hasattr(cls, name) and not any(f"self.{name}" in source for source in sources):
            yield name
