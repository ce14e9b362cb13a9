"""What networks say about views: the bridge from NumPy's evaluation to torch's networks."""

import hashlib
from collections.abc import Collection, Sequence
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor, nn

from imagination.data.collate import Batch, observations
from imagination.evaluation.approaches import Predictions
from imagination.models.unit import Prediction
from imagination.utils.cache import code_version
from imagination.utils.errors import UserError
from imagination.utils.precision import answering, resolved
from imagination.views.collector import Views

PACKAGES = ("models", "mapping")
"""Whose code decides, beside that of the cache's makers, what an evaluation finds."""


ANSWERS = ("tta_hflip", "postprocess_dilation")
"""Attributes of networks that say how they answer; no weights tell."""


@runtime_checkable
class Model(Protocol):
    """A trained unit, as LitUnit is one."""

    categories: list[str]

    def predict(self, batch: Batch) -> Prediction:
        """Probabilities of the unit's categories."""


@runtime_checkable
class Segmenter(Protocol):
    """A network for first-person segmentation, as LitSegmentation is one."""

    categories: list[str]

    def segment(self, rgb: Tensor, rows: int, columns: int) -> Tensor:
        """The class of each pixel, (B, `rows`, `columns`): 0 for none, else the category's place + 1."""


class Predictor:
    """The networks of an evaluation: units side by side, the paper's imagination module, and a segmentation network.

    Args:
        models: units and at most one segmentation network; each category comes from the unit that has it.
        categories: that are evaluated.
        table: names of the category table's rows, which images of categories are indices into.
        batch_size: views predicted at once.
        precision: what they answer in, one of `PRECISIONS`.

    Raises:
        UserError: if a category that is evaluated comes from none or several of the networks of a kind.
    """

    def __init__(
        self,
        models: Sequence[Model | Segmenter],
        categories: Sequence[str],
        table: Sequence[str],
        batch_size: int,
        precision: str = "32-true",
    ) -> None:
        self.models = list(models)
        self.units = [model for model in models if isinstance(model, Model)]
        self.segmenters = [model for model in models if isinstance(model, Segmenter)]
        self.batch_size = batch_size
        self.precision = resolved(precision)
        held = [name for unit in self.units for name in unit.categories]
        for name in categories:
            if self.units and held.count(name) != 1:
                raise UserError(
                    f"category {name!r}: got {held.count(name)} units that imagine it, expected one"
                )
            if any(name not in segmenter.categories for segmenter in self.segmenters):
                raise UserError(f"category {name!r}: the segmentation network does not know it")
        if len(self.segmenters) > 1:
            raise UserError(f"got {len(self.segmenters)} segmentation networks, expected one at most")
        self._order = [held.index(name) for name in categories] if self.units else []
        # from a segmentation network's classes to indices of the table
        self._rows = [
            np.array(
                [0, *(table.index(name) + 1 if name in table else 0 for name in segmenter.categories)],
                np.uint8,
            )
            for segmenter in self.segmenters
        ]

    @property
    def gives(self) -> frozenset[str]:
        """Which of `NEEDS` it fulfils."""
        maps = {"maps", "raw_maps", "maps_of_shuffled_rgb"} if self.units else set()
        return frozenset(maps | ({"images"} if self.segmenters else set()))

    @cached_property
    def fingerprint(self) -> str:
        """Changes with weights, categories, how networks answer, precision and the code that makes maps of it."""
        digest = hashlib.sha256((code_version(PACKAGES) + self.precision).encode())
        for model in self.models:
            assert isinstance(model, nn.Module)
            settings = [vars(part).get(name) for part in model.modules() for name in ANSWERS]
            digest.update(repr((type(model).__qualname__, model.categories, settings)).encode())
            for name, tensor in model.state_dict().items():
                digest.update(name.encode())
                digest.update(
                    tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes()
                )
        return digest.hexdigest()

    @torch.inference_mode()
    def __call__(self, views: Views, wanted: Collection[str]) -> Predictions:
        """Those of `NEEDS` that are wanted, for each view."""
        answers: Predictions = {}
        with answering(self.precision, self._device):
            if {"maps", "raw_maps"} & set(wanted):
                both = self._maps(views)
                answers |= {
                    name: maps
                    for name, maps in zip(("maps", "raw_maps"), both, strict=True)
                    if name in wanted
                }
            if "maps_of_shuffled_rgb" in wanted:
                # each view gets the colours of the one half a round further on: of its own only if it is the only one
                shift = (len(views["rgb"]) + 1) // 2
                shuffled = {**views, "rgb": np.roll(views["rgb"], shift, axis=0)}
                answers["maps_of_shuffled_rgb"], _ = self._maps(shuffled)
            if "images" in wanted:
                answers["images"] = self._images(views)
        return answers

    @property
    def _device(self) -> str:
        """Kind of the device that the networks are on, e.g. "cuda"."""
        modules = (model for model in self.models if isinstance(model, nn.Module))
        weights = (weight for module in modules for weight in module.parameters())
        return next((weight.device.type for weight in weights), "cpu")

    def _maps(self, views: Views) -> tuple[Float32[np.ndarray, "n c v v"], Float32[np.ndarray, "n c v v"]]:
        """What all units answer, and the same before it was averaged and dilated."""
        chunks = []
        for start in range(0, len(views["pose"]), self.batch_size):
            part = {
                name: views[name][start : start + self.batch_size]
                for name in ("rgb", "depth", "occupied", "seen")
            }
            batch = observations(part)
            each = zip(*(unit.predict(batch) for unit in self.units), strict=True)
            chunks.append([torch.cat(maps, dim=1).cpu()[:, self._order].numpy() for maps in each])
        maps, raw = (np.concatenate(kind) for kind in zip(*chunks, strict=True))
        return maps, raw

    def _images(self, views: Views) -> UInt8[np.ndarray, "n h w"]:
        (segmenter,), (rows,) = self.segmenters, self._rows
        chunks = []
        for start in range(0, len(views["pose"]), self.batch_size):
            rgb = torch.from_numpy(views["rgb"][start : start + self.batch_size]).permute(0, 3, 1, 2)
            chunks.append(rows[segmenter.segment(rgb, *views["depth"].shape[1:]).cpu().numpy()])
        return np.concatenate(chunks)
