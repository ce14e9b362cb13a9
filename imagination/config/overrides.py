"""Parsing of command-line overrides, and the values of a configuration by dotted key."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from imagination.config.key_roles import OPTIONAL_GROUPS, RESULT_ROLES, role


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


def result_overrides(overrides: Sequence[str], config: DictConfig) -> list[str]:
    """Return the overrides that affect the results of a run, e.g. "experiment=chair_unet" or "seed=3".

    A reference is replaced by its value, and of a dictionary only the keys that affect results are kept.

    Args:
        overrides: overrides of the run.
        config: composed config of the run.
    """
    return [kept for text in overrides if "_target_" not in text for kept in _result_parts(text, config)]


def _result_parts(override: str, config: DictConfig) -> Iterator[str]:
    keys = set_keys(override)
    kept = [key for key in keys if role(key) in RESULT_ROLES]
    if len(kept) == len(keys) and "${" not in override:
        yield override
        return
    for key in kept:
        value = OmegaConf.select(config, key)
        plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
        yield f"++{key}={json.dumps(plain)}"


def normalized(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with the overrides of groups that Hydra refuses in the form that it accepts.

    `+group=option` of an optional group has no plus, `group=null` of an optional group is left out, and `logger=null`
    deletes the group.

    >>> normalized(["+experiment=chair_unet", "sweep=null", "logger=null", "+trainer.profiler=simple"])
    ['experiment=chair_unet', '~logger', '+trainer.profiler=simple']
    """
    without_plus = [
        word.lstrip("+") if override_key(word) in (*OPTIONAL_GROUPS, "logger") else word for word in words
    ]
    chosen = [word for word in without_plus if word not in {f"{group}=null" for group in OPTIONAL_GROUPS}]
    return ["~logger" if word == "logger=null" else word for word in chosen]


def set_keys(override: str) -> list[str]:
    """Return the dotted keys that an override sets; a dictionary as its value sets those within it.

    >>> set_keys("cache={folder: /data, max_gigabytes: 1}"), set_keys("+experiment=chair_unet")
    (['cache.folder', 'cache.max_gigabytes'], ['experiment'])
    """
    parsed = OverridesParser.create().parse_override(override)
    key, value = override_key(override), parsed.value()
    return (
        [f"{key}.{name}" for name, _ in leaves(_plain(value))] if isinstance(value, dict) and value else [key]
    )


def _plain(value: Any) -> Any:
    """Return a parsed value with plain text as the keys of dictionaries."""
    return {str(name): _plain(item) for name, item in value.items()} if isinstance(value, dict) else value


def assignment(key: str, text: str) -> str:
    """Return the override that sets a key to a text, in quotes if Hydra would not read it as it is.

    >>> assignment("folder", "outputs/made/latest"), assignment("folder", "my runs")
    ('folder=outputs/made/latest', "folder='my runs'")
    """
    if re.fullmatch(r"[\w/.:+@%-]*[A-Za-z_/][\w/.:+@%-]*", text, re.ASCII) and text != "null":
        return f"{key}={text}"
    quoted = re.sub(r"(\\*)'", r"\1\1\\'", text)  # backslashes before a quote are doubled
    quoted = re.sub(r"(\\+)$", r"\1\1", quoted).replace("${", "\\${")
    return f"{key}='{quoted}'"


def override_key(override: str) -> str:
    """Return the key or group that an override sets."""
    return override.lstrip("+~").partition("=")[0]


def override_group(override: str) -> str:
    """Return the top-level node or group of an override."""
    return re.split("[@./]", override_key(override))[0]
