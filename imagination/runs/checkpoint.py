"""Checkpoints: what a run's file holds besides weights, and how it becomes a model again.

A checkpoint carries the groups chosen and plain values, never a `_target_`: what is built comes from the installed
conf and plugins, so that a stranger's file cannot name code to run.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from hydra.errors import HydraException
from hydra.utils import instantiate
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.plugins.io import TorchCheckpointIO
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imagination.config.compose import compose
from imagination.models.weights import mismatches
from imagination.runs.folder import LAST
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import UserError

KEY = "imagination"
"""Our entry in the dictionary that Lightning saves."""

CHOICE = re.compile(r"(?!hydra)[+~]*[A-Za-z][\w./@]*(=.*)?")
"""An override as on a command line, e.g. "model/encoder=timm" or "seed=3", of anything but Hydra itself."""


class ConfigInCheckpoint(Callback):
    """Puts the run's choices and plain values into each of its checkpoints."""

    def __init__(self, config: DictConfig) -> None:
        values = plain_values(config)
        self.description = {"choices": values.pop("choices"), "values": values}

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        checkpoint[KEY] = self.description


class CheckpointFiles(TorchCheckpointIO):
    """Writes each checkpoint whole or not at all, and reads them as data only."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = BytesIO()  # torch writing to a full disk itself hides the cause
        torch.save(checkpoint, content)
        with replacing(Path(path)) as temporary:
            temporary.write_bytes(content.getbuffer())

    def load_checkpoint(
        self, path: Any, map_location: Any = "cpu", weights_only: bool | None = True
    ) -> dict[str, Any]:
        return read_state(Path(path), map_location)


def read_state(path: Path, map_location: Any = "cpu") -> dict[str, Any]:
    """The dictionary in a checkpoint file.

    Raises:
        UserError: if there is no such file, it is damaged, or it was not written by this program.
    """
    try:
        state = torch.load(path, map_location=map_location, weights_only=True)
    except FileNotFoundError as error:
        raise UserError(f"checkpoint: got {path}, but there is no such file") from error
    except Exception as error:  # torch raises whatever the broken part makes it raise
        raise UserError(
            f"checkpoint {path}: cannot be read, it is truncated or holds more than plain data; use another one "
            "(each run keeps checkpoints/last.ckpt and checkpoints/best.ckpt)"
        ) from error
    if not isinstance(state, dict) or KEY not in state or "state_dict" not in state:
        raise UserError(
            f"checkpoint {path}: was not written by imagination.train; expected a file of checkpoints/"
        )
    return state


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that was read.

    Attributes:
        path: of its file.
        state: what Lightning saved, our description included.
    """

    path: Path
    state: Mapping[str, Any]

    @classmethod
    def read(cls, path: str | Path) -> "Checkpoint":
        """Read a file.

        Raises:
            UserError: see `read_state`.
        """
        return cls(Path(path), read_state(Path(path)))

    @cached_property
    def config(self) -> DictConfig:
        """The run's config: targets from the installed conf and plugins, plain values from the checkpoint.

        Raises:
            UserError: if the description holds anything but choices and plain values.
        """
        choices, values = self.state[KEY]["choices"], self.state[KEY]["values"]
        for text in [*choices, *_texts(values)]:
            if "${" in text or "_target_" in text:
                raise UserError(
                    f"checkpoint {self.path}: holds {text!r}; expected plain values, do not use this file"
                )
        for text in choices:
            if not CHOICE.fullmatch(text) or ".." in text:  # no path that leaves the conf tree
                raise UserError(
                    f"checkpoint {self.path}: holds {text!r}, expected the choice of a group's option"
                )
        try:
            composed = compose("train", [*choices, "paths.run=."])
        # as without the plugin that it was trained with
        except (HydraException, OmegaConfBaseException) as error:
            raise UserError(f"checkpoint {self.path}: its choices cannot be composed: {error}") from error
        merged: dict[str, Any] = _with_values(OmegaConf.to_container(composed, resolve=True), values)
        return OmegaConf.create(merged)

    @property
    def categories(self) -> list[str]:
        """What it predicts."""
        return list(self.config.unit_categories)

    @property
    def predicts(self) -> str:
        """Egocentric "maps", or first-person "images"."""
        return str(self.config.model.predicts)

    @property
    def record(self) -> dict[str, Any]:
        """What `TrainingStats` counted, of the whole run where its last checkpoint lies beside; empty without it.

        Beside it `flat`, whether the training ended because its score was flat (`EarlyStopping`).
        """
        last = self.path.with_name(LAST.name)
        callbacks = (read_state(last) if last.is_file() else self.state).get("callbacks", {})
        counts: dict[str, Any] = callbacks.get("TrainingStats", {})
        return counts and {**counts, "flat": callbacks.get("EarlyStopping", {}).get("flat", False)}

    @property
    def scenes(self) -> dict[str, str]:
        """Names and fingerprints of the scenes that it was trained in; none where it does not say."""
        states = [state for state in self.state.values() if isinstance(state, dict)]
        return next((dict(state["scenes"]) for state in states if isinstance(state.get("scenes"), dict)), {})

    def require(self, config: DictConfig, whose: str = "the evaluation") -> None:
        """Check that the checkpoint was trained for the camera and the maps of a config.

        Args:
            config: of the evaluation, or of another checkpoint.
            whose: it is, for the message.

        Raises:
            UserError: if it was not, with both.
        """
        values, asked = self.state[KEY]["values"], plain_values(config)
        has, wanted = (float(tree["ego"]["resolution"]) for tree in (values, asked))
        if has != wanted:
            raise UserError(
                f"checkpoint {self.path}: is of {', '.join(self.categories)} at {has} m a cell, but {whose} asks for "
                f"{', '.join(asked['unit_categories'])} at {wanted} m; choose another checkpoint, or leave out what "
                "overrides them"
            )
        for node in ("camera", "ego"):
            if values[node] != asked[node]:
                raise UserError(
                    f"checkpoint {self.path}: was trained with the {node} {values[node]}, but {whose} asks for "
                    f"{asked[node]}; choose another checkpoint, or leave out what overrides it"
                )

    def model(self) -> LightningModule:
        """The trained LightningModule, in evaluation mode on the CPU.

        Raises:
            UserError: if the weights do not fit the model that the installed conf describes.
        """
        module = OmegaConf.to_container(self.config.model.module, resolve=True)
        _load_no_weights(module)
        model: LightningModule = instantiate(module)
        try:
            model.load_state_dict(self.state["state_dict"])
        except RuntimeError as error:
            raise UserError(
                f"checkpoint {self.path}: its weights do not fit the model that the installed conf describes; "
                f"use the version that it was trained with; {mismatches(self.state['state_dict'], model.state_dict())}"
            ) from error
        return model.eval()


def plain_values(config: DictConfig) -> dict[str, Any]:
    """A config's values without what decides which code runs, and without this machine's paths."""
    values: dict[str, Any] = _plain(OmegaConf.to_container(config, resolve=True))
    return values


def _plain(node: Any) -> Any:
    if isinstance(node, dict):
        return {
            key: _plain(value) for key, value in node.items() if not key.startswith("_") and key != "paths"
        }
    return [_plain(value) for value in node] if isinstance(node, list) else node


def _load_no_weights(node: Any) -> None:
    """Build encoders without the weights that training may have started from: the checkpoint brings its own."""
    for key, value in node.items() if isinstance(node, dict) else ():
        if key == "pretrained":
            node[key] = False
        _load_no_weights(value)


def _texts(node: Any) -> Iterator[str]:
    """Every string in a tree of plain values, keys included."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield str(key)
            yield from _texts(value)
    elif isinstance(node, (list, tuple)):
        for value in node:
            yield from _texts(value)
    elif isinstance(node, str):
        yield node


def _with_values(composed: Any, values: Any) -> Any:
    """`values` in the place of what was composed; targets, which `values` lack, stay."""
    if isinstance(composed, dict) and isinstance(values, dict):
        return {**composed, **{key: _with_values(composed.get(key), value) for key, value in values.items()}}
    if isinstance(composed, list) and isinstance(values, list) and len(composed) == len(values):
        return [_with_values(old, new) for old, new in zip(composed, values, strict=True)]
    return values
