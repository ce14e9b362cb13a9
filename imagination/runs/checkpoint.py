"""Reading and writing of checkpoints, which hold the run's configuration besides the weights.

A checkpoint stores the overrides and plain values of the configuration, never a `_target_`. Targets come from the
installed conf and plugins, so that a checkpoint from an untrusted source cannot name code to run.
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
from lightning import LightningModule
from lightning.pytorch.plugins.io import TorchCheckpointIO
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imagination.config.compose import compose
from imagination.config.key_roles import RESULT_ROLES, role
from imagination.config.overrides import override_key, set_keys
from imagination.config.unknown_keys import is_group
from imagination.data.datamodule import TRAINING_SCENES
from imagination.models.task_kind import TaskKind
from imagination.models.weights import mismatches
from imagination.runs.folder import LAST
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import UserError, check_choice

KEY = LightningModule.CHECKPOINT_HYPER_PARAMS_KEY
"""Key of the hyperparameters in the dictionary that Lightning saves: overrides (`choices`) and plain values."""

OVERRIDE = re.compile(r"(?!hydra)[+~]*[A-Za-z][\w./@-]*(=.*)?", re.DOTALL)
"""Pattern of the allowed overrides, e.g. "model/encoder=timm" or "seed=3"; overrides of Hydra itself are refused."""


def hyperparameters(config: DictConfig) -> dict[str, Any]:
    """Return the hyperparameters that checkpoints of a run hold: the overrides and plain values of its config."""
    values = plain_values(config)
    return {"choices": values.pop("choices"), "values": values}


def check_readable(saved: dict[str, Any]) -> None:
    """Check before a training that its checkpoints can be read again.

    Raises:
        UserError: if the config cannot be composed from the hyperparameters.
    """
    _ = Checkpoint(LAST, {KEY: saved}).config


class CheckpointFiles(TorchCheckpointIO):
    """Checkpoint IO that writes files atomically and reads plain data only."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = BytesIO()  # torch.save to a full disk hides the cause of the error
        torch.save(checkpoint, content)
        with replacing(Path(path)) as temporary:
            temporary.write_bytes(content.getbuffer())

    def load_checkpoint(
        self, path: Any, map_location: Any = "cpu", weights_only: bool | None = True
    ) -> dict[str, Any]:
        return read_state(Path(path), map_location)


def read_state(path: Path, map_location: Any = "cpu") -> dict[str, Any]:
    """Return the dictionary in a checkpoint file.

    Raises:
        UserError: if the file does not exist, is damaged, or was not written by `imagination.train`.
    """
    try:
        state = torch.load(path, map_location=map_location, weights_only=True)
    except FileNotFoundError as error:
        raise UserError(f"checkpoint: got {path}, but there is no such file") from error
    except Exception as error:  # torch raises errors of any type on a damaged file
        raise UserError(
            f"checkpoint {path}: cannot be read; it is truncated or holds more than plain data; use another checkpoint "
            "(each run keeps checkpoints/last.ckpt and checkpoints/best.ckpt)"
        ) from error
    if not isinstance(state, dict) or "state_dict" not in state or not _has_config(state.get(KEY)):
        raise UserError(
            f"checkpoint {path}: was not written by imagination.train; expected a file of checkpoints/"
        )
    return state


def load(path: str | Path) -> LightningModule:
    """Return the trained module of a checkpoint; `LitTask.load_from_checkpoint` calls this function.

    Raises:
        UserError: see `Checkpoint`.
    """
    return Checkpoint.read(path).model()


@dataclass(frozen=True)
class Checkpoint:
    """Content of a checkpoint file.

    Attributes:
        path: path of the file.
        state: dictionary that Lightning saved, with the configuration under `KEY`.
    """

    path: Path
    state: Mapping[str, Any]

    @classmethod
    def read(cls, path: str | Path) -> "Checkpoint":
        """Read a checkpoint file.

        Raises:
            UserError: see `read_state`.
        """
        return cls(Path(path), read_state(Path(path)))

    @cached_property
    def overrides(self) -> list[str]:
        """Overrides of the run that determine its results.

        Raises:
            UserError: if the file holds an override of another kind, such as `paths.cache=/elsewhere`.
        """
        overrides = self.state[KEY]["choices"]
        for text in [*overrides, *_texts(self.state[KEY]["values"])]:
            if "${" in text or "_target_" in text:
                raise self._refused(text, "plain values")
        for text in overrides:
            key = override_key(text)
            leaves_conf = ".." in key or (".." in text and is_group(key))
            if not OVERRIDE.fullmatch(text) or leaves_conf:
                raise self._refused(text, "an override such as model/encoder=timm or seed=3")
            for key in set_keys(text):
                if role(key) not in RESULT_ROLES:
                    raise self._refused(text, "overrides of the training or the evaluation")
        return list(overrides)

    @cached_property
    def config(self) -> DictConfig:
        """Config of the run.

        Targets, references, and everything about paths and execution come from the installed conf and plugins; other
        plain values come from the checkpoint.

        Raises:
            UserError: if the saved configuration holds anything but overrides and plain values.
        """
        try:
            composed = compose("train", [*self.overrides, "paths.run=."])
        except (
            HydraException,
            OmegaConfBaseException,
            UserError,
        ) as error:  # e.g. a plugin of the training is not installed
            raise UserError(
                f"checkpoint {self.path}: got overrides that cannot be composed ({error}); install the plugins that "
                "it was trained with"
            ) from error
        merged: dict[str, Any] = _with_values(OmegaConf.to_container(composed), self.state[KEY]["values"])
        config = OmegaConf.create(merged)
        OmegaConf.resolve(config)
        return config

    def _refused(self, text: str, expected: str) -> UserError:
        return UserError(f"checkpoint {self.path}: holds {text!r}, expected {expected}; do not use this file")

    @property
    def categories(self) -> list[str]:
        """Names of the predicted categories."""
        return list(self.config.unit_categories)

    @property
    def kind(self) -> TaskKind:
        """Kind of prediction."""
        return TaskKind(check_choice("model.predicts", self.config.model.predicts, TaskKind))

    @property
    def training_stats(self) -> dict[str, Any]:
        """Counts of `TrainingStats`, and in `flat` whether `EarlyStopping` ended the training.

        They are those of the whole run if its last checkpoint is in the same folder, and empty if the training had no
        `TrainingStats`.
        """
        last = self.path.with_name(LAST.name)
        callbacks = (read_state(last) if last.is_file() else self.state).get("callbacks", {})
        counts: dict[str, Any] = callbacks.get("TrainingStats", {})
        states = (state for key, state in callbacks.items() if key.startswith("EarlyStopping"))
        stopping: dict[str, Any] = next(states, {})
        flat = stopping.get("wait_count", 0) >= stopping.get("patience", 1)
        return counts and {**counts, "flat": flat}

    @cached_property
    def scenes(self) -> dict[str, str]:
        """Fingerprints of the training scenes by identity; empty if the checkpoint does not hold them.

        Raises:
            UserError: if the file was written by a version that stored no identities.
        """
        states = [state for state in self.state.values() if isinstance(state, dict)]
        if any(isinstance(state.get("scenes"), dict) for state in states):
            raise UserError(
                f"checkpoint {self.path}: holds fingerprints of its training scenes, expected their identities; it was "
                "written by another version of the program: train again"
            )
        return next((dict(state[TRAINING_SCENES]) for state in states if TRAINING_SCENES in state), {})

    def check_compatible(self, config: DictConfig, source: str = "the evaluation") -> None:
        """Check that the checkpoint was trained with the camera and the egocentric grid of a config.

        Args:
            config: config of the evaluation, or of another checkpoint.
            source: source of the config, for the message.

        Raises:
            UserError: if the camera or the grid differs.
        """
        values, required = self.state[KEY]["values"], plain_values(config)
        resolution, expected = (float(tree["ego"]["resolution"]) for tree in (values, required))
        if resolution != expected:
            raise UserError(
                f"checkpoint {self.path}: predicts {', '.join(self.categories)} at a resolution of {resolution} m, but "
                f"{source} expects {', '.join(required['unit_categories'])} at {expected} m; use another checkpoint, "
                "or remove the overrides of the resolution"
            )
        for node in ("camera", "ego"):
            if values[node] != required[node]:
                raise UserError(
                    f"checkpoint {self.path}: was trained with {node}={values[node]}, but {source} expects "
                    f"{required[node]}; use another checkpoint, or remove the overrides of {node}"
                )

    def model(self) -> LightningModule:
        """Return the trained LightningModule in evaluation mode on the CPU.

        Raises:
            UserError: if the weights do not match the model in the installed conf.
        """
        module = OmegaConf.to_container(self.config.model.module, resolve=True)
        _disable_pretrained(module)
        model: LightningModule = instantiate(module)
        try:
            model.load_state_dict(self.state["state_dict"])
        except RuntimeError as error:
            raise UserError(
                f"checkpoint {self.path}: its weights do not match the model in the installed conf; use the version of "
                f"the program that it was trained with; {mismatches(self.state['state_dict'], model.state_dict())}"
            ) from error
        return model.eval()


def _has_config(saved: Any) -> bool:
    """Return whether saved hyperparameters are those of a run."""
    return isinstance(saved, dict) and {"choices", "values"} <= saved.keys()


def plain_values(config: DictConfig) -> dict[str, Any]:
    """Return the values of a config without targets (keys with a leading underscore) and paths."""
    values: dict[str, Any] = _plain(OmegaConf.to_container(config, resolve=True))
    return values


def _plain(node: Any) -> Any:
    if isinstance(node, dict):
        return {
            key: _plain(value) for key, value in node.items() if not key.startswith("_") and key != "paths"
        }
    return [_plain(value) for value in node] if isinstance(node, list) else node


def _disable_pretrained(node: Any) -> None:
    """Set every `pretrained` to False, because the weights come from the checkpoint."""
    for key, value in node.items() if isinstance(node, dict) else ():
        if key == "pretrained":
            node[key] = False
        _disable_pretrained(value)


def _texts(node: Any) -> Iterator[str]:
    """Yield every string in a tree of plain values, including keys."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield str(key)
            yield from _texts(value)
    elif isinstance(node, (list, tuple)):
        for value in node:
            yield from _texts(value)
    elif isinstance(node, str):
        yield node


def _with_values(composed: Any, values: Any, key: str = "") -> Any:
    """Return a composed config with the saved values of the keys that determine results.

    Targets and references of the composed config stay, and so do the keys that it does not have.
    """
    if isinstance(composed, dict):
        known = values if isinstance(values, dict) else {}
        return {
            name: _with_values(node, known[name], f"{key}.{name}".lstrip(".")) if name in known else node
            for name, node in composed.items()
        }
    if isinstance(composed, list) and isinstance(values, list) and len(composed) == len(values):
        return [_with_values(old, new, key) for old, new in zip(composed, values, strict=True)]
    is_reference = isinstance(composed, str) and "${" in composed
    if is_reference or key.rpartition(".")[2].startswith("_") or isinstance(values, dict):
        return composed
    return values if role(key) in RESULT_ROLES else composed
