"""Parsers of the files of a training: configs, checkpoints, cache entries."""

import hashlib
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.config.contracts import check_plugin
from imagination.config.plugin_registry import Plugin, _examine
from imagination.runs.checkpoint import KEY, Checkpoint, hyperparameters
from imagination.runs.composed_config import END, read_composed_config
from imagination.utils.cache import MAGIC, DamagedError, decode, encode
from tests.robustness.parsers.parser import Parser, resealed


def sealed(path: Path) -> object:
    """Decode an entry with a valid checksum, as an attacker would write it."""
    body = path.read_bytes()
    return decode(MAGIC + hashlib.sha256(body).digest() + body)


@cache
def entries() -> list[bytes]:
    arrays = {
        "mask": np.arange(21).reshape(3, 7) % 3 == 0,
        "depth": np.linspace(0, 8, 10, dtype=np.float16),
        "rgb": np.zeros((2, 3, 3), np.uint8),
        "nothing": np.zeros((0, 4), bool),
    }
    return [encode(arrays), encode({})]


def bodies() -> list[bytes]:
    """Return the entries without header and checksum."""
    return [entry[len(MAGIC) + hashlib.sha256().digest_size :] for entry in entries()]


@cache
def checkpoints() -> list[bytes]:
    config = compose("train", ["+experiment=chair_unet", "scale=test", "paths.run=."])
    config.choices = ["+experiment=chair_unet", "scale=test"]
    state = {"state_dict": {"weight": torch.zeros(2)}, KEY: hyperparameters(config)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.ckpt"
        torch.save(state, path)
        return [path.read_bytes()]


@cache
def configs() -> list[bytes]:
    config = compose("train", ["+experiment=chair_unet", "scale=test", "paths.run=."])
    return [(OmegaConf.to_yaml(config) + END).encode()]


def config_of(path: Path) -> object:
    return Checkpoint.read(path).config


def plugin(path: Path) -> str:
    """Examine a plugin with this config."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copyfile(path, Path(folder) / "a.yaml")
        examined = Plugin("p", "here", conf=Path(folder))
        return _examine(examined, {}, {}) or check_plugin(examined)


PARSERS = [
    Parser("config", read_composed_config, configs),
    Parser(
        "plugin-conf", plugin, lambda: [b"_target_: imagination.utils.errors.UserError\nkey: [1, 2.5, a]\n"]
    ),
    Parser("checkpoint", config_of, checkpoints),
    Parser("checkpoint-resealed", *resealed(config_of, checkpoints)),
    Parser("cache", lambda path: decode(path.read_bytes()), entries, (DamagedError,)),
    Parser("cache-sealed", sealed, bodies, (DamagedError,)),
]
