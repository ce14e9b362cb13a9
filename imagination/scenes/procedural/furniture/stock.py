"""What one home's furniture is taken from: pieces of its split in the finishes of its palette."""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import Piece
from imagination.scenes.procedural.furniture.armchairs import build_armchair
from imagination.scenes.procedural.furniture.beds import build_bed
from imagination.scenes.procedural.furniture.chairs import build_chair
from imagination.scenes.procedural.furniture.desks import build_desk
from imagination.scenes.procedural.furniture.distractors import BUILDERS, build_distractor
from imagination.scenes.procedural.furniture.low_tables import build_low_table
from imagination.scenes.procedural.furniture.office_chairs import build_office_chair
from imagination.scenes.procedural.furniture.styles import Style, draw_style
from imagination.scenes.procedural.furniture.tables import build_dining_table
from imagination.scenes.source import Credit, Split

STYLED: Mapping[str, Callable[[Style, Palette], Piece]] = {
    "chair": build_chair,
    "office_chair": build_office_chair,
    "armchair": build_armchair,
    "dining_table": build_dining_table,
    **dict.fromkeys(("coffee_table", "side_table"), build_low_table),
    **dict.fromkeys(("double_bed", "single_bed", "bunk_bed"), build_bed),
    "desk": build_desk,
}
"""Labels whose shapes differ between splits, and what builds them."""

LABELS: tuple[str, ...] = (*STYLED, *BUILDERS)
"""Every label that things in a home may have."""


@runtime_checkable
class Furniture(Protocol):
    """Where the pieces of homes come from. Plain values only inside, so that worker processes receive a copy of it.

    A piece stands in a frame of its own: x to the right, y to the front, z up, its lowest point at 0. Tables have
    `seats` and `surfaces`, a desk exactly one seat; nightstands and side tables at least one surface.
    """

    def piece(self, label: str, split: Split, palette: Palette, rng: np.random.Generator) -> Piece:
        """A piece with one of LABELS. Splits share no model of the labels in STYLED."""

    def fingerprint(self) -> str:
        """A string that changes whenever a piece changes."""

    def credits(self) -> Sequence[Credit]:
        """The models that others made, which results must name; may be empty."""


class ProceduralFurniture:
    """Furniture made by rule."""

    def piece(self, label: str, split: Split, palette: Palette, rng: np.random.Generator) -> Piece:
        """A new piece, of a style of its own."""
        if label in STYLED:
            return STYLED[label](draw_style(label, split, rng), palette)
        return build_distractor(label, palette, rng)

    def fingerprint(self) -> str:
        """Nothing: the code that homes come from makes it."""
        return ""

    def credits(self) -> Sequence[Credit]:
        """None: nobody else made it."""
        return ()


class Stock:
    """Hands out pieces for one home.

    Args:
        furniture: where they come from.
        split: whose models are used.
        rng: of the home.
    """

    def __init__(self, furniture: Furniture, split: Split, rng: np.random.Generator) -> None:
        self.rng = rng
        self.palette = Palette(rng)
        self._furniture, self._split = furniture, split

    def piece(self, label: str) -> Piece:
        """A new piece, of a style of its own; place it several times for several of the same."""
        return self._furniture.piece(label, self._split, self.palette, self.rng)

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return bool(self.rng.random() < probability)
