"""What the units say about views: the bridge from NumPy's evaluation to torch's networks."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from imagination.data.batches import Batch, observations
from imagination.views.collector import Views


@runtime_checkable
class Model(Protocol):
    """A trained unit, as UnitTraining is one."""

    def predict(self, batch: Batch) -> Tensor:
        """Probabilities of the unit's categories, (B, C, V, V)."""


class Predictor:
    """Predicts the categories of several units side by side, the paper's imagination module.

    Args:
        models: of one or more categories each, in the order of the categories evaluated.
        batch_size: views predicted at once.
    """

    def __init__(self, models: Sequence[Model], batch_size: int) -> None:
        self.models = list(models)
        self.batch_size = batch_size

    @torch.inference_mode()
    def __call__(self, views: Views) -> Float32[np.ndarray, "n c v v"]:
        """Probabilities of all categories for each view."""
        chunks = []
        for start in range(0, len(views["pose"]), self.batch_size):
            part = {
                name: views[name][start : start + self.batch_size]
                for name in ("rgb", "depth", "occupied", "seen")
            }
            batch = observations(part)
            chunks.append(torch.cat([model.predict(batch).cpu() for model in self.models], dim=1).numpy())
        return np.concatenate(chunks)
