"""Which classes a configuration read from a file may build."""

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
"""Where classes that a config read from a file builds may be defined, besides plugins."""

RESOLVER = re.compile(r"\$\{[\w.]+:")
"""A call inside a value, such as ${oc.decode:…}, which could make a target out of text."""


def check_targets(config: DictConfig) -> None:
    """Check that a config read from a file builds only classes of the program, its plugins and its libraries.

    Raises:
        UserError: if a `_target_` is something else or cannot be found, or a value calls a resolver.
    """
    if call := RESOLVER.search(OmegaConf.to_yaml(config)):
        raise UserError(
            f"config: got a value with {call[0]!r}, expected plain values and references; start a new run"
        )
    allowed = {*TRUSTED, *(package for plugin in activate() for package in plugin.packages)}
    tops = {prefix.partition(".")[0] for prefix in allowed}
    for target in dict.fromkeys(targets_of(OmegaConf.to_container(config))):
        try:
            made = hydra.utils.get_object(target) if target.partition(".")[0] in tops else None
        except (ImportError, AttributeError) as error:
            raise UserError(
                f"_target_: got {target!r}, which cannot be found; install its plugin again"
            ) from error
        # a class, or the class of a method that makes one; where it is defined counts, not the path that leads to it
        kind = made if inspect.isclass(made) else getattr(made, "__self__", None)
        scene = kind.__module__ if inspect.isclass(kind) else ""
        if not any(scene == prefix or scene.startswith(f"{prefix}.") for prefix in allowed):
            raise UserError(
                f"_target_: got {target!r}, expected a class defined in {', '.join(sorted(allowed))}; "
                "if you trust it, start a new run with it"
            )
