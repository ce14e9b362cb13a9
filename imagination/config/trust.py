"""Allowlist of the classes that a configuration from a file may instantiate."""

import inspect
import re

import hydra
from omegaconf import DictConfig, OmegaConf

from imagination.config.plugin_registry import activate, targets_of
from imagination.utils.errors import UserError

TRUSTED = (
    "imagination",
    "lightning.pytorch.trainer",
    "lightning.pytorch.callbacks",
    "lightning.pytorch.loggers",
    "torch.nn",
    "torch.optim",
    "torchmetrics",
)
"""Packages whose classes a config from a file may instantiate, in addition to plugins."""

RESOLVER = re.compile(r"\$\{[\w.]+:")
"""Pattern of a resolver call in a value, such as ${oc.decode:…}, which could construct a `_target_` from text."""


def check_targets(config: DictConfig) -> None:
    """Check that a config from a file instantiates only classes of the project, its plugins and its libraries.

    Raises:
        UserError: if a `_target_` is not allowed or cannot be found, or a value calls a resolver.
    """
    if call := RESOLVER.search(OmegaConf.to_yaml(config)):
        raise UserError(
            f"config: got a value with the resolver {call[0]!r}, expected constants and references; start a new run"
        )
    allowed = {*TRUSTED, *(package for plugin in activate() for package in plugin.packages)}
    top_packages = {prefix.partition(".")[0] for prefix in allowed}
    for target in dict.fromkeys(targets_of(OmegaConf.to_container(config))):
        try:
            obj = hydra.utils.get_object(target) if target.partition(".")[0] in top_packages else None
        except (ImportError, AttributeError) as error:
            raise UserError(
                f"_target_: got {target!r}, which cannot be imported; install its plugin"
            ) from error
        # a class or a classmethod; the module that defines the class decides, not the path that imports it
        cls = obj if inspect.isclass(obj) else getattr(obj, "__self__", None)
        module = cls.__module__ if inspect.isclass(cls) else ""
        if not any(module == prefix or module.startswith(f"{prefix}.") for prefix in allowed):
            raise UserError(
                f"_target_: got {target!r}, expected a class defined in {', '.join(sorted(allowed))}; "
                "if you trust it, start a new run with it"
            )
