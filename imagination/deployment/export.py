"""Checkpoints to files that run without training's code: ONNX and torch.export, each checked on real views."""

import warnings
from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra.utils import instantiate
from jaxtyping import Bool, Float32
from omegaconf import DictConfig
from torch import Tensor, nn

from imagination.deployment.onnx_backend import KEY, NAMES, arrays
from imagination.deployment.torch_backend import ENTRY, Probabilities, TrainedUnit, inputs
from imagination.evaluation.metrics import count, iou
from imagination.geometry.morphology import kernel_cells
from imagination.ground_truth.targets import label
from imagination.mapping.predictor import (
    ImaginationModule,
    Observation,
    UnitSpec,
    joined,
    valid_imagination,
)
from imagination.models.encoders import TimmEncoder
from imagination.runs.checkpoint import Checkpoint
from imagination.scenes.source import Split
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import require_extra
from imagination.views.observer import Observer
from imagination.views.pose_samplers import sample_poses


class Sample(NamedTuple):
    """A real view: what the units are given, and what they were trained to answer."""

    observation: Observation
    label: Bool[np.ndarray, "c v v"]


class Check(NamedTuple):
    """How a file compares with PyTorch.

    Attributes:
        difference: largest, of probabilities.
        iou, reference_iou: of each category's egocentric map with the labels, pooled over views, at the category's
            threshold; of the file and of PyTorch. Those that no label holds are left out: nothing can be said of them.
    """

    difference: float
    iou: dict[str, float]
    reference_iou: dict[str, float]

    @property
    def loss(self) -> float:
        """Of IoU, in the category that loses most."""
        return max(self.reference_iou[name] - value for name, value in self.iou.items())

    def told(self) -> str:
        """The IoU of all categories, for people."""
        return ", ".join(
            f"{name} {value:.4f} (PyTorch {self.reference_iou[name]:.4f})" for name, value in self.iou.items()
        )


class InBfloat16(nn.Module):
    """Units whose convolutions are computed in bfloat16; places in the grid stay exact."""

    def __init__(self, module: Probabilities) -> None:
        super().__init__()
        self.module = module

    def forward(self, *observation: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            probabilities: Tensor = self.module(*observation)
        return probabilities


def export(
    checkpoints: Sequence[Checkpoint],
    path: Path,
    format: str,
    precision: str,
    calibration: Sequence[Sample],
    look_once: bool = False,
) -> None:
    """Write the units of some checkpoints, side by side, into one file.

    Args:
        checkpoints: of different categories, trained with the same camera and grid.
        path: of the file.
        format: onnx or torch_export.
        precision: one that the format has; see `PRECISIONS`.
        calibration: views that int8's ranges are taken from; one of them is traced.
        look_once: see `Probabilities`.

    Raises:
        UserError: if what writes the format is not installed, a checkpoint gives no maps, the units do not fit
            together, or the disk is full.
    """
    units, descriptions = zip(*map(TrainedUnit.of, checkpoints), strict=True)
    module, spec = Probabilities(list(units), look_once), reduce(joined, descriptions)
    text = spec.to_json(precision=precision, normalisation=normalisation(module), look_once=look_once)
    example = inputs(calibration[0].observation)
    with torch.no_grad(), warnings.catch_warnings():  # torch's own, about its exporter
        warnings.simplefilter("ignore")
        traced = InBfloat16(module) if precision == "bfloat16" else module
        program = torch.export.export(traced, example)
        if format == "torch_export":
            with replacing(path) as temporary:
                torch.export.save(program, temporary, extra_files={ENTRY: text})
        else:
            write_onnx(program, path, text, calibration if precision == "int8" else ())


def write_onnx(program: Any, path: Path, text: str, calibration: Sequence[Sample]) -> None:
    """Write a program as ONNX with our description in it; convolutions in int8 if there are views to calibrate with.

    Raises:
        UserError: if the packages that write ONNX are not installed.
    """
    for package in ("onnx", "onnxscript"):  # torch's exporter needs the latter
        require_extra(package, "onnx")
    import onnx

    written = torch.onnx.export(
        program,
        input_names=list(NAMES),
        output_names=["probabilities"],
        dynamo=True,
        verbose=False,
    )
    assert written is not None, "the exporter with dynamo returns a program"
    model = written.model_proto
    with replacing(path) as temporary:
        if calibration:
            model = quantised(model, temporary, calibration)
        entry = model.metadata_props.add()
        entry.key, entry.value = KEY, text
        onnx.save(model, temporary)


def quantised(model: Any, scratch: Path, calibration: Sequence[Sample]) -> Any:
    """A copy of an ONNX model whose convolutions are computed in int8, their ranges taken from views."""
    import onnx
    from onnxruntime.quantization import (
        CalibrationDataReader,
        CalibrationMethod,
        QuantFormat,
        QuantType,
        quantize_static,
    )

    class Views(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            names = {node.name for node in model.graph.input}
            feeds = (arrays(sample.observation).items() for sample in calibration)
            self.feeds = iter([{name: array for name, array in feed if name in names} for feed in feeds])

        def get_next(self) -> dict[str, np.ndarray] | None:
            return next(self.feeds, None)

    quantize_static(
        model,
        scratch,
        Views(),
        quant_format=QuantFormat.QDQ,
        op_types_to_quantize=["Conv"],
        per_channel=True,
        calibrate_method=CalibrationMethod.Percentile,  # with the whole range, a few large values cost all others
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
    )
    return onnx.load(scratch)


def sample_views(config: DictConfig, split: Split, count: int) -> list[Sample]:
    """Views of scenes of a split, as the checkpoint's run looked at them, a few a scene."""
    observer: Observer = instantiate(config.data.observer)
    layers = [observer.categories.index(name) - 1 for name in config.unit_categories]
    kernel = kernel_cells(config.kernels.imaginable, observer.ego.resolution)
    rng = np.random.default_rng(0)
    scenes = observer.source.scenes(split)[: max(2, count // 8)]
    samples = []
    for number, scene in enumerate(scenes):
        share = len(range(number, count, len(scenes)))
        for pose in sample_poses(observer.scene(scene).free_space, share, rng):
            view = observer.observe(scene, pose, rng)
            seen = Observation(view.rgb, view.depth, view.occupied, view.seen, observer.camera.mount_height)
            samples.append(Sample(seen, label(view.object[layers], view.seen[None], kernel)))
    return samples


def compare(module: ImaginationModule, reference: ImaginationModule, samples: Sequence[Sample]) -> Check:
    """Ask two modules about the same views."""
    known, difference = module.spec, 0.0
    counts = np.zeros((2, len(known.categories), 3), np.int64)
    for sample in samples:
        answers = [each(sample.observation) for each in (module, reference)]
        difference = max(difference, float(np.abs(answers[0] - answers[1]).max()))
        for total, answer in zip(counts, answers, strict=True):
            found = egocentric_map(answer, sample.observation.seen, known)
            total += [count(*each) for each in zip(found, sample.label, strict=True)]
    held = counts[0, :, 2] > 0
    ours, theirs = (
        {
            name: float(value)
            for name, value, there in zip(known.categories, iou(total), held, strict=True)
            if there
        }
        for total in counts
    )
    return Check(difference, ours, theirs)


def egocentric_map(
    probabilities: Float32[np.ndarray, "c v v"], seen: Bool[np.ndarray, "v v"], known: UnitSpec
) -> Bool[np.ndarray, "c v v"]:
    """The objects of an answer, as training scores them: V_valid from the categories' thresholds on."""
    said = valid_imagination(
        probabilities, seen[None], known.valid_threshold, known.valid_kernel, known.ego.resolution
    )
    thresholds = np.array(known.thresholds, np.float32)[:, None, None]
    objects: Bool[np.ndarray, "c v v"] = said.values >= thresholds
    return objects


def normalisation(module: Probabilities) -> list[dict[str, Any]]:
    """What each unit does to colours, 0 to 255, itself."""
    encoders = [part for part in module.modules() if isinstance(part, TimmEncoder)]
    return [
        {"mean": encoder.mean.flatten().tolist(), "deviation": encoder.deviation.flatten().tolist()}
        for encoder in encoders
    ]
