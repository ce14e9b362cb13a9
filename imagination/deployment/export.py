"""Export of checkpoints to ONNX and torch.export, and comparison of the files with PyTorch on rendered views."""

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
    MapPredictor,
    Observation,
    UnitSpec,
    join_specs,
    valid_imagination,
)
from imagination.models.encoders import TimmEncoder
from imagination.runs.checkpoint import Checkpoint
from imagination.scenes.source import Split
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import require_extra
from imagination.views.observer import Observer
from imagination.views.pose_samplers import sample_poses

TOLERANCE = 1e-4
"""Largest difference of a float32 file's probabilities from PyTorch."""

MAX_IOU_LOSS = 0.005
"""Largest loss of egocentric IoU of a file at lower precision, in each category."""


class Sample(NamedTuple):
    """Rendered view: the observation and the label of the units."""

    observation: Observation
    label: Bool[np.ndarray, "c v v"]


class Check(NamedTuple):
    """Comparison of a file with PyTorch.

    Attributes:
        difference: largest absolute difference of the probabilities.
        iou, reference_iou: IoU of each category's egocentric map with the labels, pooled over views, at the category's
            threshold, for the file and for PyTorch. Categories that are in no label are left out.
    """

    difference: float
    iou: dict[str, float]
    reference_iou: dict[str, float]

    @property
    def loss(self) -> float:
        """Largest loss of IoU among the categories."""
        return max(self.reference_iou[name] - value for name, value in self.iou.items())

    def summary(self) -> str:
        """Format the IoU of all categories."""
        return ", ".join(
            f"{name} {value:.4f} (PyTorch {self.reference_iou[name]:.4f})" for name, value in self.iou.items()
        )


class InBfloat16(nn.Module):
    """Units whose convolutions run in bfloat16; grid coordinates stay exact."""

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
) -> None:
    """Write the units of several checkpoints into one file.

    Args:
        checkpoints: checkpoints of different categories, trained with the same camera and grid.
        path: path of the file.
        format: onnx or torch_export.
        precision: precision of the format; see `PRECISIONS`.
        calibration: views for the ranges of int8; the first one is traced.

    Raises:
        UserError: if the exporter is not installed, a checkpoint does not predict maps, the units do not fit together,
            or the disk is full.
    """
    units, specs = zip(*map(TrainedUnit.of, checkpoints), strict=True)
    module, spec = Probabilities(list(units)), reduce(join_specs, specs)
    text = spec.to_json(precision=precision, normalisation=normalisation(module))
    example = inputs(calibration[0].observation)
    with torch.no_grad(), warnings.catch_warnings():  # warnings of torch's exporter
        warnings.simplefilter("ignore")
        traced = InBfloat16(module) if precision == "bfloat16" else module
        program = torch.export.export(traced, example)
        if format == "torch_export":
            with replacing(path) as temporary:
                torch.export.save(program, temporary, extra_files={ENTRY: text})
        else:
            write_onnx(program, path, text, calibration if precision == "int8" else ())


def write_onnx(program: Any, path: Path, text: str, calibration: Sequence[Sample]) -> None:
    """Write a program as ONNX with the unit specification `text`; convolutions are int8 if `calibration` is not empty.

    Raises:
        UserError: if the packages that write ONNX are not installed.
    """
    for package in ("onnx", "onnxscript"):  # torch's exporter needs onnxscript
        require_extra(package, "onnx")
    import onnx

    exported = torch.onnx.export(
        program,
        input_names=list(NAMES),
        output_names=["probabilities"],
        dynamo=True,
        verbose=False,
    )
    assert exported is not None, "the exporter with dynamo returns a program"
    model = exported.model_proto
    with replacing(path) as temporary:
        if calibration:
            model = quantise(model, temporary, calibration)
        entry = model.metadata_props.add()
        entry.key, entry.value = KEY, text
        onnx.save(model, temporary)


def quantise(model: Any, scratch: Path, calibration: Sequence[Sample]) -> Any:
    """Return a copy of an ONNX model with int8 convolutions whose ranges are calibrated on views."""
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
        calibrate_method=CalibrationMethod.Percentile,  # the full range would be dominated by a few large values
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
    )
    return onnx.load(scratch)


def sample_views(config: DictConfig, split: Split, count: int) -> list[Sample]:
    """Render views of a split's scenes with the observer of a checkpoint's run, a few per scene."""
    observer: Observer = instantiate(config.data.observer)
    layers = [observer.categories.index(name) - 1 for name in config.unit_categories]
    kernel = kernel_cells(config.kernels.imaginable, observer.ego.resolution)
    rng = np.random.default_rng(0)
    scenes = observer.source.scenes(split)[: max(2, count // 8)]
    samples = []
    for number, scene in enumerate(scenes):
        views_of_scene = len(range(number, count, len(scenes)))
        for pose in sample_poses(observer.scene(scene).free_space, views_of_scene, rng):
            view = observer.observe(scene, pose, rng)
            observation = Observation(
                view.rgb, view.depth, view.occupied, view.seen, observer.camera.mount_height
            )
            samples.append(Sample(observation, label(view.object[layers], view.seen[None], kernel)))
    return samples


def compare(predictor: MapPredictor, reference: MapPredictor, samples: Sequence[Sample]) -> Check:
    """Compare the predictions of two predictors on the same views."""
    spec, difference = predictor.spec, 0.0
    counts = np.zeros((2, len(spec.categories), 3), np.int64)
    for sample in samples:
        predictions = [each(sample.observation) for each in (predictor, reference)]
        difference = max(difference, float(np.abs(predictions[0] - predictions[1]).max()))
        for total, prediction in zip(counts, predictions, strict=True):
            objects = egocentric_map(prediction, sample.observation.seen, spec)
            total += [count(*pair) for pair in zip(objects, sample.label, strict=True)]
    in_labels = counts[0, :, 2] > 0
    predictor_iou, reference_iou = (
        {
            name: float(value)
            for name, value, present in zip(spec.categories, iou(total), in_labels, strict=True)
            if present
        }
        for total in counts
    )
    return Check(difference, predictor_iou, reference_iou)


def egocentric_map(
    probabilities: Float32[np.ndarray, "c v v"], seen: Bool[np.ndarray, "v v"], spec: UnitSpec
) -> Bool[np.ndarray, "c v v"]:
    """Return the object cells of a prediction as scored in training: V_valid at the categories' thresholds."""
    evidence = valid_imagination(
        probabilities, seen[None], spec.valid_threshold, spec.valid_kernel, spec.ego.resolution
    )
    thresholds = np.array(spec.thresholds, np.float32)[:, None, None]
    objects: Bool[np.ndarray, "c v v"] = evidence.values >= thresholds
    return objects


def normalisation(module: Probabilities) -> list[dict[str, Any]]:
    """Return the normalisation of colours (0 to 255) that each unit applies."""
    encoders = [part for part in module.modules() if isinstance(part, TimmEncoder)]
    return [
        {"mean": encoder.mean.flatten().tolist(), "deviation": encoder.deviation.flatten().tolist()}
        for encoder in encoders
    ]
