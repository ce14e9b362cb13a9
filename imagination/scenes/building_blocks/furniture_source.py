"""Interface of furniture sources, from which procedural homes take their pieces; plugins may implement it."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import Piece
from imagination.scenes.source import Credit, Split

SOURCE = "procedural"
"""Key of `aliases` in the category table under which furniture labels are listed."""

STYLED_LABELS: tuple[str, ...] = (
    *("chair", "office_chair", "armchair"),
    *("dining_table", "coffee_table", "side_table", "desk"),
    *("double_bed", "single_bed", "bunk_bed"),
)
"""Labels whose shapes differ between splits."""

LABELS: tuple[str, ...] = (
    *STYLED_LABELS,
    *("wardrobe", "dresser", "nightstand", "sideboard", "tv_stand", "shelf", "kitchen_counter", "wall_units"),
    *(
        "fridge",
        "bath",
        "toilet",
        "basin",
        "sofa",
        "stool",
        "pouf",
        "bench",
        "floor_lamp",
        "table_lamp",
        "plant",
    ),
    *("rug", "picture", "books", "vase", "bowl", "monitor", "carton", "basket"),
)
"""All labels of furniture in a procedural home."""


@runtime_checkable
class Furniture(Protocol):
    """Source of the pieces of procedural homes. It holds plain values only, so that worker processes receive a copy.

    The frame of a piece has x to the right, y to the front and z up, with its lowest point at 0. Tables have `seats`
    and `surfaces`, a desk exactly one seat, nightstands and side tables at least one surface.
    """

    def piece(self, label: str, split: Split, palette: Palette, rng: np.random.Generator) -> Piece | None:
        """Return a piece with one of LABELS, or None where a procedural piece should be used instead.

        Splits must not share models of STYLED_LABELS.
        """

    def fingerprint(self) -> str:
        """Return a string that changes whenever data or settings change a piece; cache keys also hold the code."""

    def credits(self) -> Sequence[Credit]:
        """Return the models by other authors, which results must credit; may be empty."""
