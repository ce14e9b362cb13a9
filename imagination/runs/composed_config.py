"""Composed config of a run, with its interpolations: written at the start, checked and read when the run resumes."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from imagination.config.key_roles import Role, role
from imagination.config.overrides import leaves
from imagination.config.references import check_references
from imagination.config.trust import check_targets
from imagination.config.validation import validate
from imagination.utils.atomic_io import write_text
from imagination.utils.errors import UserError
from imagination.utils.tabular import read_yaml

END = "...\n"
"""Last line of a composed config (end of a YAML document); a file without it is truncated."""


def write_composed_config(path: Path, config: DictConfig) -> None:
    """Write the composed config of a run atomically."""
    write_text(path, OmegaConf.to_yaml(config) + END)


def keep_references(config: DictConfig, key: str) -> None:
    """Replace the references to a key by its value, so that a change of the key does not change them.

    For example, the learning-rate schedule refers to trainer.max_epochs, but keeps its length when the training is
    extended.
    """
    value = OmegaConf.select(config, key)
    values: Any = OmegaConf.to_container(config)
    for other, reference in leaves(values):
        if reference == f"${{{key}}}" and role(other) == Role.TRAINING:
            OmegaConf.update(config, other, value)


def read_composed_config(path: Path) -> DictConfig:
    """Read and check the composed config of a run.

    Raises:
        UserError: if the file is damaged or holds invalid values or untrusted targets.
    """
    saved = load_composed_config(path)
    try:
        check_targets(saved)
        validate(saved)
    except UserError:
        raise
    except Exception as error:  # validation accesses nodes that may be missing or of another type
        raise UserError(f"config {path}: is truncated or damaged ({error}); start a new run") from error
    return saved


def load_composed_config(path: Path) -> DictConfig:
    """Load the composed config of a run, which nothing may be instantiated from before it is checked.

    Raises:
        UserError: if the file is damaged, or too large with its references replaced.
    """
    values = read_yaml(path, last_line=END)
    check_references(values)
    saved = OmegaConf.create(values)
    OmegaConf.set_struct(saved, True)
    return saved
