"""Code that determines the result of a training, by which finished trainings of other code are recognised."""

import hashlib
from contextlib import suppress
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imagination.config.key_roles import Role, role
from imagination.config.trust import nodes
from imagination.utils.cache import code_version
from imagination.utils.code_hash import is_plugin, module_hash, module_of

PACKAGES = (
    *("callbacks", "data", "geometry", "ground_truth", "models", "scenes", "views"),
    *("utils/jit.py", "utils/precision.py", "utils/process_group.py", "runs/trainer.py", "train.py"),
)
"""Packages and modules of the core whose code determines the result of a training."""


def program(config: DictConfig) -> str:
    """Return the hash of the code of a training: that of the core, and of plugins' classes in keys of the training.

    The code of all plugins' classes in the config is read now, since files may be edited while the training runs.
    """
    values: Any = OmegaConf.to_container(config)
    with suppress(OmegaConfBaseException):  # reported when the training starts
        values = OmegaConf.to_container(config, resolve=True)
    code = {}
    for place, node in nodes(values):
        target = str(node.get("_target_", ""))
        if is_plugin(target) and (module := module_of(target)):
            code[place] = module_hash(module)
    trained = {place: digest for place, digest in code.items() if role(f"{place}._target_") == Role.TRAINING}
    return hashlib.sha256(repr((code_version(PACKAGES), sorted(trained.items()))).encode()).hexdigest()
