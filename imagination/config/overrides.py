"""Command-line overrides and the values of a configuration."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any


def sweeps(word: str) -> bool:
    """Whether a word of a command line asks for several runs."""
    return word in ("-m", "--multirun") or word.lstrip("+").startswith(("sweep=", "hparams_search="))


def leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Values of a resolved config by dotted key; the class of what a node builds goes by the node's name."""
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
"""Nodes that say where and how a run runs, not what it trains: a checkpoint leaves overrides of them out."""


def choices(overrides: Sequence[str]) -> list[str]:
    """Those overrides that say what is trained, e.g. "+experiment=chair_unet" or "seed=3"."""

    def kept(text: str) -> bool:
        return top(text) not in WHERE_AND_HOW and "_target_" not in text and "${" not in text

    return [text for text in overrides if kept(text)]


def key(override: str) -> str:
    """What an override sets."""
    return override.lstrip("+~").partition("=")[0]


def top(override: str) -> str:
    """The node or group of the config that an override is about."""
    return re.split("[@./]", key(override))[0]
