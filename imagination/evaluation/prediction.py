"""Predictions of trained PyTorch networks for views given as NumPy arrays."""

import hashlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import is_dataclass
from functools import cached_property
from types import FunctionType
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from lightning import LightningModule
from torch import Tensor, nn
from torchmetrics import Metric

from imagination.data.collate import Batch, observations
from imagination.evaluation.approaches import Predictions
from imagination.models.task_kind import TaskKind
from imagination.models.unit import Prediction
from imagination.utils.cache import code_version
from imagination.utils.cache_key import as_plain
from imagination.utils.code_hash import code_of, is_core, is_plugin
from imagination.utils.errors import UserError
from imagination.utils.precision import autocast, resolved
from imagination.views.collector import Views

PACKAGES = ("models", "utils/precision.py")
"""Packages and modules whose code determines predictions, besides those in every key of the cache."""

HPARAMS = ("_hparams", "_hparams_initial", "_hparams_name")
"""Attributes with the hyperparameters of a run, which only a network in training has."""

INTERNAL = frozenset([*vars(nn.Module()), *vars(LightningModule()), *HPARAMS])
"""Attributes that torch and Lightning set on networks."""


@runtime_checkable
class Network(Protocol):
    """Trained network: a `LitTask`, or public weights such as `PublicHRNet`.

    A network of `TaskKind.MAPS` has `predict`, one of `TaskKind.IMAGES` has `segment`.
    """

    categories: list[str]

    @property
    def kind(self) -> TaskKind:
        """Kind of prediction."""


@runtime_checkable
class MapNetwork(Network, Protocol):
    """Network that predicts egocentric maps, such as `LitUnit`."""

    def predict(self, batch: Batch) -> Prediction:
        """Predict the probabilities of the unit's categories."""


@runtime_checkable
class SegmentationNetwork(Network, Protocol):
    """Network that segments images, such as `LitSegmentation`."""

    def segment(self, rgb: Tensor, rows: int, columns: int) -> Tensor:
        """Predict the class of each pixel, (B, `rows`, `columns`): 0 for no category, else the category's index + 1."""


class Predictor:
    """Networks of an evaluation: the units of the paper's imagination module and a segmentation network.

    Args:
        models: units and at most one segmentation network; one unit predicts each category.
        categories: names of the evaluated categories.
        table: names of the rows of the category table, into which images of categories are indices.
        batch_size: views per batch.
        precision: floating-point precision of the predictions, one of `PRECISIONS`.

    Raises:
        UserError: if not exactly one unit predicts an evaluated category, the segmentation network lacks one, or there
            are several segmentation networks.
    """

    def __init__(
        self,
        models: Sequence[Network],
        categories: Sequence[str],
        table: Sequence[str],
        batch_size: int,
        precision: str = "32-true",
    ) -> None:
        self.models = list(models)
        self.units = [cast(MapNetwork, model) for model in models if model.kind is TaskKind.MAPS]
        self.segmenters = [
            cast(SegmentationNetwork, model) for model in models if model.kind is TaskKind.IMAGES
        ]
        self.batch_size = batch_size
        self.precision = resolved(precision)
        predicted = [name for unit in self.units for name in unit.categories]
        for name in categories:
            if self.units and predicted.count(name) != 1:
                raise UserError(
                    f"category {name!r}: got {predicted.count(name)} units that predict it, expected one"
                )
            if any(name not in segmenter.categories for segmenter in self.segmenters):
                raise UserError(f"category {name!r}: is not among those of the segmentation network")
        if len(self.segmenters) > 1:
            raise UserError(f"got {len(self.segmenters)} segmentation networks, expected one at most")
        self._order = [predicted.index(name) for name in categories] if self.units else []
        # index in the category table by class of the segmentation network
        self._rows = [
            np.array(
                [0, *(table.index(name) + 1 if name in table else 0 for name in segmenter.categories)],
                np.uint8,
            )
            for segmenter in self.segmenters
        ]

    @property
    def gives(self) -> frozenset[str]:
        """Predictions that the networks provide, a subset of `NEEDS`."""
        maps = {"maps", "raw_maps", "maps_of_shuffled_rgb"} if self.units else set()
        return frozenset(maps | ({"images"} if self.segmenters else set()))

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the code, settings and weights of the networks, the precision and the type of the device."""
        digest = hashlib.sha256(repr((code_version(PACKAGES), self.precision, self._device)).encode())
        for model in self.models:
            assert isinstance(model, nn.Module)
            digest.update(repr(model.categories).encode())
            for name, part in model.named_modules():
                digest.update(repr((name, _class_of(part), _settings(part))).encode())
                for key, tensor in _tensors(part):
                    digest.update(key.encode())
                    values = tensor.detach().cpu().contiguous().flatten().view(torch.uint8)
                    digest.update(values.numpy().tobytes())
        return digest.hexdigest()

    @torch.inference_mode()
    def __call__(self, views: Views, wanted: Collection[str]) -> Predictions:
        """Predict those of `NEEDS` that are in `wanted` for each view."""
        predictions: Predictions = {}
        with autocast(self.precision, self._device):
            if {"maps", "raw_maps"} & set(wanted):
                pair = self._maps(views)
                predictions |= {
                    name: maps
                    for name, maps in zip(("maps", "raw_maps"), pair, strict=True)
                    if name in wanted
                }
            if "maps_of_shuffled_rgb" in wanted:
                # each view gets the colours of the view half a cycle later: its own only if it is the only view
                shift = (len(views["rgb"]) + 1) // 2
                shuffled = {**views, "rgb": np.roll(views["rgb"], shift, axis=0)}
                predictions["maps_of_shuffled_rgb"], _ = self._maps(shuffled)
            if "images" in wanted:
                predictions["images"] = self._images(views)
        return predictions

    @property
    def _device(self) -> str:
        """Device type of the networks, e.g. "cuda"."""
        modules = (model for model in self.models if isinstance(model, nn.Module))
        weights = (weight for module in modules for weight in module.parameters())
        return next((weight.device.type for weight in weights), "cpu")

    def _maps(self, views: Views) -> tuple[Float32[np.ndarray, "n c v v"], Float32[np.ndarray, "n c v v"]]:
        """Predict the maps of all units: postprocessed, and raw (before averaging and dilation)."""
        chunks = []
        for start in range(0, len(views["pose"]), self.batch_size):
            part = {
                name: views[name][start : start + self.batch_size]
                for name in ("rgb", "depth", "occupied", "seen")
            }
            batch = observations(part)
            outputs = zip(*(unit.predict(batch) for unit in self.units), strict=True)
            chunks.append([torch.cat(maps, dim=1).cpu()[:, self._order].numpy() for maps in outputs])
        maps, raw = (np.concatenate(kind) for kind in zip(*chunks, strict=True))
        return maps, raw

    def _images(self, views: Views) -> UInt8[np.ndarray, "n h w"]:
        """Predict first-person segmentations as indices into the category table."""
        (segmenter,), (rows,) = self.segmenters, self._rows
        chunks = []
        for start in range(0, len(views["pose"]), self.batch_size):
            rgb = torch.from_numpy(views["rgb"][start : start + self.batch_size]).permute(0, 3, 1, 2)
            chunks.append(rows[segmenter.segment(rgb, *views["depth"].shape[1:]).cpu().numpy()])
        return np.concatenate(chunks)


def _class_of(part: nn.Module) -> tuple[str, str, str]:
    """Return the module, the name and the code of the class of a network's part."""
    cls = type(part)
    return cls.__module__, cls.__qualname__, code_of(cls.__module__)


def _settings(part: nn.Module) -> Any:
    """Return what a part of a network predicts with besides weights: attributes, or what a library prints of it."""
    module = type(part).__module__
    if isinstance(part, Metric):  # its attributes are results
        return None
    if not is_core(module) and not is_plugin(module):
        return part.extra_repr()
    settings = {}
    for name, value in vars(part).items():
        if name not in INTERNAL and _is_setting(value):
            with suppress(UserError):  # e.g. a function in a list; the class's code is hashed
                settings[name] = as_plain(value)
    return settings


def _is_setting(value: Any) -> bool:
    """Return whether an attribute is a value or of a plugin, not another object such as the factory of an optimiser."""
    kinds = (bool, int, float, str, list, tuple, Mapping, np.ndarray, Tensor)
    defined = value if isinstance(value, (type, FunctionType)) else type(value)
    return isinstance(value, kinds) or is_dataclass(value) or is_plugin(defined.__module__ or "builtins")


def _tensors(part: nn.Module) -> Iterator[tuple[str, Tensor]]:
    """Yield the weights and buffers of a part of a network without those of its own parts."""
    yield from part.named_parameters(recurse=False)
    yield from part.named_buffers(recurse=False)
