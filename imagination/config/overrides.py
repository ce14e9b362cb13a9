"""Parsing of command-line overrides, and the values of a configuration by dotted key."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any


def sweeps(word: str) -> bool:
    """Return whether a word of a command line starts a sweep."""
    return word in ("-m", "--multirun") or word.lstrip("+").startswith(("sweep=", "hparams_search="))


def leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of a resolved config by dotted key; a node with a `_target_` yields the name of the class."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        elif key == "_target_":
            yield prefix.removesuffix("."), str(value).rpartition(".")[2]
        elif not key.startswith("_"):
            yield f"{prefix}{key}", value


WHERE_AND_HOW = (
    *("paths", "cache", "callbacks", "trainer", "logger", "ckpt_path", "resume", "hydra"),
    *("sweep", "sweep_dir", "hparams_search"),
)
"""Nodes that do not affect the training result; their overrides are not stored in checkpoints."""


def training_overrides(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that affect the training result, e.g. "+experiment=chair_unet" or "seed=3"."""

    def affects_training(text: str) -> bool:
        return override_group(text) not in WHERE_AND_HOW and "_target_" not in text and "${" not in text

    return [text for text in overrides if affects_training(text)]


def override_key(override: str) -> str:
    """Return the key or group that an override sets."""
    return override.lstrip("+~").partition("=")[0]


def override_group(override: str) -> str:
    """Return the top-level node or group of an override."""
    return re.split("[@./]", override_key(override))[0]
