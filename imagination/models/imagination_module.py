"""Imagination module of the paper (section IV-B): identical, independent units, one per category."""

from collections.abc import Sequence
from copy import deepcopy

import torch
from jaxtyping import Float, Float16, UInt8
from torch import Tensor, nn

from imagination.models.unit import Unit
from imagination.utils.errors import UserError


class ImaginationModule(Unit):
    """Units that share only their inputs, trained in one run.

    Losses are summed and no weight is shared, so each unit gets the gradients of training alone. The units start with
    equal weights, as units that are trained alone with the same seed do.

    Args:
        unit: unit of one category, which is copied for each category.
        categories: names of the categories, one per unit.

    Raises:
        UserError: if the unit has several categories.
    """

    def __init__(self, unit: Unit, categories: Sequence[str]) -> None:
        super().__init__(categories)
        if len(unit.categories) != 1:
            raise UserError(
                f"model.unit.unit: got a unit of {', '.join(unit.categories)}, expected one category; "
                "each category gets a copy"
            )
        self.units = nn.ModuleList(deepcopy(unit) for _ in self.categories)

    def logits(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """Return the logits of all units; see `Unit`."""
        return torch.cat([unit.logits(rgb, depth, occupied, seen) for unit in self._units()], dim=1)

    def raw(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """Return the raw logits of all units; see `Unit`."""
        return torch.cat([unit.raw(rgb, depth, occupied, seen) for unit in self._units()], dim=1)

    def postprocess(self, raw: Float[Tensor, "b c v v"]) -> Float[Tensor, "b c v v"]:
        """Return the postprocessed logits of all units; see `Unit`."""
        pairs = zip(self._units(), torch.split(raw, 1, dim=1), strict=True)
        return torch.cat([unit.postprocess(logits) for unit, logits in pairs], dim=1)

    def _units(self) -> list[Unit]:
        return [unit for unit in self.units if isinstance(unit, Unit)]
