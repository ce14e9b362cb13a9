"""Parsers of what training leaves: configs, checkpoints, the cache."""

import hashlib
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.config.plugin_registry import Plugin, _examine, check
from imagination.runs.checkpoint import KEY, Checkpoint, ConfigInCheckpoint
from imagination.runs.resume import END, _read
from imagination.utils.cache import MAGIC, DamagedError, decode, encode
from tests.robustness.parsers.parser import Parser, resealed


def sealed(path: Path) -> object:
    """Decode an entry whose checksum fits, as a stranger would see to."""
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
    """What lies behind the checksum."""
    return [entry[len(MAGIC) + hashlib.sha256().digest_size :] for entry in entries()]


@cache
def checkpoints() -> list[bytes]:
    config = compose("train", ["+experiment=chair_unet", "scale=test", "paths.run=."])
    config.choices = ["+experiment=chair_unet", "scale=test"]
    state = {"state_dict": {"weight": torch.zeros(2)}, KEY: ConfigInCheckpoint(config).description}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.ckpt"
        torch.save(state, path)
        return [path.read_bytes()]


@cache
def configs() -> list[bytes]:
    config = compose("train", ["+experiment=chair_unet", "scale=test", "paths.run=."])
    config.sweep_dir = None  # as the command leaves it out
    return [(OmegaConf.to_yaml(config) + END).encode()]


def config_of(path: Path) -> object:
    return Checkpoint.read(path).config


def plugin(path: Path) -> str:
    """Look at a plugin with such a config."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copyfile(path, Path(folder) / "a.yaml")
        found = Plugin("p", "here", conf=Path(folder))
        return _examine(found, {}, {}) or check(found)


PARSERS = [
    Parser("config", _read, configs),
    Parser(
        "plugin-conf", plugin, lambda: [b"_target_: imagination.utils.errors.UserError\nkey: [1, 2.5, a]\n"]
    ),
    Parser("checkpoint", config_of, checkpoints),
    Parser("checkpoint-resealed", *resealed(config_of, checkpoints)),
    Parser("cache", lambda path: decode(path.read_bytes()), entries, (DamagedError,)),
    Parser("cache-sealed", sealed, bodies, (DamagedError,)),
]
