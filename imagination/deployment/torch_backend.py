"""Units that run on torch: checkpoints as training wrote them, and programs of torch.export."""

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
from imagination.models.unit import Unit
from imagination.runs.checkpoint import Checkpoint
from imagination.utils.errors import UserError

ENTRY = "imagination.json"
"""Our description in a file of torch.export."""

PLAIN_DATA = {"TORCH_FORCE_WEIGHTS_ONLY_LOAD": "1", "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "0"}
"""Variables that let `torch.load` unpickle nothing but plain data, whoever calls it."""


class Probabilities(nn.Module):
    """Units side by side as one function of a robot's observation.

    Units that look at depth themselves hold the mount height that they were trained with; the robot's takes its place.

    Args:
        units: in evaluation mode.
        look_once: leave out the mirror image of a view, about which they may otherwise be asked as well.
    """

    def __init__(self, units: list[Unit], look_once: bool = False) -> None:
        super().__init__()
        self.units = nn.ModuleList(units).eval()
        for part in self.units.modules():
            if isinstance(part, Unit) and look_once:
                part.tta_hflip = False
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
        """Probabilities of V_object of all units' categories."""
        every = []
        for index, unit in enumerate(self.units):
            prefix = f"{index}."
            own = {
                name.removeprefix(prefix): mount_height for name in self.heights if name.startswith(prefix)
            }
            every.append(functional_call(unit, own, (rgb, depth, occupied, seen)))
        return torch.cat(every, dim=1).float().sigmoid()


class TrainedUnit(NamedTuple):
    """What a checkpoint holds for a robot."""

    unit: Unit
    spec: UnitSpec

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> "TrainedUnit":
        """Those of a checkpoint.

        Raises:
            UserError: if it segments images instead of imagining maps, or is damaged.
        """
        if checkpoint.predicts != "maps":
            raise UserError(
                f"unit: got {checkpoint.path}, which gives {checkpoint.predicts}, expected a checkpoint that gives "
                "maps, as +experiment=chair_unet trains one"
            )
        model: Any = checkpoint.model()
        if not 0 <= model.chosen.min() <= model.chosen.max() < len(THRESHOLDS):
            raise UserError(
                f"checkpoint {checkpoint.path}: got the thresholds number {model.chosen.tolist()}, expected 0 to "
                f"{len(THRESHOLDS) - 1}; use another one"
            )
        return cls(model.unit, describe(checkpoint.config, model.chosen_thresholds.tolist()))


class CheckpointModule:
    """A checkpoint of imagination.train.

    Args:
        path: of its file.
        look_once: see `Probabilities`.

    Raises:
        UserError: if it cannot be read; see `Checkpoint`.
    """

    def __init__(self, path: Path, look_once: bool = False) -> None:
        trained = TrainedUnit.of(Checkpoint.read(path))
        self.spec = trained.spec
        self._run = Probabilities([trained.unit], look_once)

    @torch.inference_mode()
    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        return _run(self._run, observation)


class ExportedModule:
    """A .pt2 file of imagination.export; one from a stranger may hold code, which torch runs.

    Raises:
        UserError: if the file is broken or not ours.
    """

    def __init__(self, path: Path) -> None:
        extra = {ENTRY: ""}
        try:
            with _safely():
                program = torch.export.load(path, extra_files=extra)
                self._run = program.module()
        except Exception as error:  # torch raises whatever the broken part makes it raise
            raise UserError(
                f"{path}: cannot be read as a program of torch.export ({error}); export it again"
            ) from error
        if not extra[ENTRY]:
            raise UserError(f"{path}: was not written by imagination.export")
        self.spec = UnitSpec.from_json(extra[ENTRY], str(path))

    @torch.inference_mode()
    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        return _run(self._run, observation)


@contextmanager
def _safely() -> Iterator[None]:
    """Let `torch.load` unpickle plain data only, and leave out what is warned of and logged: errors say enough.

    `torch.export.load` would have it unpickle anything in its second try.
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
    """What a run's config says of its unit, with the thresholds that its validation chose."""
    from hydra.utils import instantiate

    camera: Camera = instantiate(config.camera)
    ego: EgoGrid = instantiate(config.ego)
    obstacles: Band = instantiate(config.obstacles)
    names = tuple(config.unit_categories)
    colours = tuple(tuple(config.categories[name].colour) for name in names)
    thresholds = tuple(round(value, 6) for value in chosen_thresholds)  # float32 makes .95 a little more
    mapping = config.mapping.valid_threshold, config.mapping.valid_kernel
    return UnitSpec(names, colours, thresholds, camera, ego, Band(*map(float, obstacles)), *mapping)


def inputs(observation: Observation) -> tuple[Tensor, ...]:
    """What `Probabilities` takes."""
    return tuple(torch.from_numpy(array) for array in arrays(observation).values())


def _run(function: Any, observation: Observation) -> Float32[np.ndarray, "c v v"]:
    probabilities: np.ndarray = function(*inputs(observation))[0].numpy()
    return probabilities
