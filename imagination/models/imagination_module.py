"""The imagination module of the paper (section III-B): identical units side by side, one for each category."""

from collections.abc import Sequence
from copy import deepcopy

import torch
from jaxtyping import Float, Float16, UInt8
from torch import Tensor, nn

from imagination.models.unit import Unit
from imagination.utils.errors import UserError


class ImaginationModule(Unit):
    """Units that share nothing but their inputs, trained as one job.

    Their losses add up and no weight belongs to two of them, so each gets the gradients that it would get alone; they
    begin with the same weights, as units that are trained alone with the same seed do.

    Args:
        unit: of one category; copied for the others.
        categories: what to imagine, a unit for each.

    Raises:
        UserError: if the unit is not of one category.
    """

    def __init__(self, unit: Unit, categories: Sequence[str]) -> None:
        super().__init__(categories)
        if len(unit.categories) != 1:
            raise UserError(
                f"model.unit.unit: got a unit of {', '.join(unit.categories)}, expected one category (each gets a copy)"
            )
        self.units = nn.ModuleList(deepcopy(unit) for _ in self.categories)

    def logits(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """See `Unit`."""
        return torch.cat([unit.logits(rgb, depth, occupied, seen) for unit in self._each()], dim=1)

    def raw(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """See `Unit`; each unit looks as often as it is made to."""
        return torch.cat([unit.raw(rgb, depth, occupied, seen) for unit in self._each()], dim=1)

    def postprocess(self, raw: Float[Tensor, "b c v v"]) -> Float[Tensor, "b c v v"]:
        """See `Unit`; each unit as it is made to."""
        each = zip(self._each(), torch.split(raw, 1, dim=1), strict=True)
        return torch.cat([unit.postprocess(own) for unit, own in each], dim=1)

    def _each(self) -> list[Unit]:
        return [unit for unit in self.units if isinstance(unit, Unit)]
