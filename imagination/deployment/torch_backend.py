"""Inference of units with torch: checkpoints of training and programs of torch.export."""

import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float16, Float32, UInt8
from omegaconf import DictConfig
from torch import Tensor, nn
from torch.func import functional_call

from imagination.deployment.onnx_backend import arrays
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.geometry.projection import Band
from imagination.mapping.predictor import Observation, UnitSpec
from imagination.models.depth_hits import DepthHits
from imagination.models.ego_metrics import THRESHOLDS
from imagination.models.task_kind import TaskKind
from imagination.models.unit import Unit
from imagination.runs.checkpoint import Checkpoint
from imagination.utils.errors import UserError

ENTRY = "imagination.json"
"""Name of the unit specification in a file of torch.export."""

PLAIN_DATA = {"TORCH_FORCE_WEIGHTS_ONLY_LOAD": "1", "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "0"}
"""Environment variables that restrict every `torch.load` to plain data."""


class Probabilities(nn.Module):
    """Several units as one function from a robot's observation to probabilities.

    Units that use depth directly store the mount height of training; it is replaced by that of the observation.

    Args:
        units: units of different categories; put into evaluation mode.
    """

    def __init__(self, units: list[Unit]) -> None:
        super().__init__()
        self.units = nn.ModuleList(units).eval()
        self.heights = [
            f"{name}.mount_height" for name, part in self.units.named_modules() if isinstance(part, DepthHits)
        ]

    def forward(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
        mount_height: Float[Tensor, ""],
    ) -> Float[Tensor, "b c v v"]:
        """Predict the probabilities of V_object for the categories of all units."""
        logits = []
        for index, unit in enumerate(self.units):
            prefix = f"{index}."
            heights = {
                name.removeprefix(prefix): mount_height for name in self.heights if name.startswith(prefix)
            }
            logits.append(functional_call(unit, heights, (rgb, depth, occupied, seen)))
        return torch.cat(logits, dim=1).float().sigmoid()


class TrainedUnit(NamedTuple):
    """Unit of a checkpoint and its specification."""

    unit: Unit
    spec: UnitSpec

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> "TrainedUnit":
        """Load the unit of a checkpoint.

        Raises:
            UserError: if the checkpoint is of a segmentation network or damaged.
        """
        if checkpoint.kind is not TaskKind.MAPS:
            raise UserError(
                f"unit: got {checkpoint.path}, which predicts {checkpoint.kind}, expected a checkpoint that predicts "
                "maps, such as one of experiment=chair_unet"
            )
        model: Any = checkpoint.model()
        if not 0 <= model.chosen.min() <= model.chosen.max() < len(THRESHOLDS):
            raise UserError(
                f"checkpoint {checkpoint.path}: got the threshold indices {model.chosen.tolist()}, expected 0 to "
                f"{len(THRESHOLDS) - 1}; use another checkpoint"
            )
        return cls(model.unit, describe(checkpoint.config, model.selected_thresholds.tolist()))


class CheckpointModule:
    """Predictor of a checkpoint of imagination.train.

    Args:
        path: path of the checkpoint.

    Raises:
        UserError: if the checkpoint cannot be read; see `Checkpoint`.
    """

    def __init__(self, path: Path) -> None:
        trained = TrainedUnit.of(Checkpoint.read(path))
        self.spec = trained.spec
        self._run = Probabilities([trained.unit])

    @torch.inference_mode()
    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        return _run(self._run, observation)


class ExportedModule:
    """Predictor of a .pt2 file of imagination.export.

    Load only trusted files: the format can hold code, which torch executes.

    Raises:
        UserError: if the file is damaged or was not written by imagination.export.
    """

    def __init__(self, path: Path) -> None:
        extra = {ENTRY: ""}
        try:
            with _safely():
                program = torch.export.load(path, extra_files=extra)
                self._run = program.module()
        except Exception as error:  # the type depends on the damaged part
            raise UserError(
                f"{path}: cannot be read as a program of torch.export ({error}); export it again"
            ) from error
        if not extra[ENTRY]:
            raise UserError(f"{path}: was not written by imagination.export, got no entry {ENTRY!r}")
        self.spec = UnitSpec.from_json(extra[ENTRY], str(path))

    @torch.inference_mode()
    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        return _run(self._run, observation)


@contextmanager
def _safely() -> Iterator[None]:
    """Restrict `torch.load` to plain data and silence warnings and logs, since the raised error suffices.

    Without the restriction, `torch.export.load` would unpickle arbitrary objects in its second attempt.
    """
    log = logging.getLogger("torch.export")
    before, variables = log.disabled, {name: os.environ.get(name) for name in PLAIN_DATA}
    log.disabled = True
    os.environ |= PLAIN_DATA
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.disabled = before
        for name in PLAIN_DATA:
            del os.environ[name]
        os.environ |= {name: value for name, value in variables.items() if value is not None}


def describe(config: DictConfig, chosen_thresholds: Sequence[float]) -> UnitSpec:
    """Return the specification of a run's unit, with the thresholds selected by its validation."""
    from hydra.utils import instantiate

    camera: Camera = instantiate(config.camera)
    ego: EgoGrid = instantiate(config.ego)
    obstacles: Band = instantiate(config.obstacles)
    names = tuple(config.unit_categories)
    colours = tuple(tuple(config.categories[name].colour) for name in names)
    # removes the float32 error, e.g. of 0.95
    thresholds = tuple(round(value, 6) for value in chosen_thresholds)
    mapping = config.mapping.valid_threshold, config.mapping.valid_kernel
    return UnitSpec(names, colours, thresholds, camera, ego, Band(*map(float, obstacles)), *mapping)


def inputs(observation: Observation) -> tuple[Tensor, ...]:
    """Convert an observation to the inputs of `Probabilities`."""
    return tuple(torch.from_numpy(array) for array in arrays(observation).values())


def _run(function: Any, observation: Observation) -> Float32[np.ndarray, "c v v"]:
    probabilities: np.ndarray = function(*inputs(observation))[0].numpy()
    return probabilities
