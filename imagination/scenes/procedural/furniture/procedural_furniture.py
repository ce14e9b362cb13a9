"""Stock of furniture of one home: pieces of its split with finishes of its palette."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from imagination.scenes.building_blocks.furniture_source import Furniture
from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import Piece
from imagination.scenes.procedural.furniture.armchairs import build_armchair
from imagination.scenes.procedural.furniture.beds import build_bed
from imagination.scenes.procedural.furniture.chairs import build_chair
from imagination.scenes.procedural.furniture.desks import build_desk
from imagination.scenes.procedural.furniture.dining_tables import build_dining_table
from imagination.scenes.procedural.furniture.distractors import build_distractor
from imagination.scenes.procedural.furniture.low_tables import build_low_table
from imagination.scenes.procedural.furniture.office_chairs import build_office_chair
from imagination.scenes.procedural.furniture.styles import Style, draw_style
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
"""Builders of the STYLED_LABELS."""


class ProceduralFurniture:
    """Source of procedural furniture."""

    def piece(self, label: str, split: Split, palette: Palette, rng: np.random.Generator) -> Piece:
        """Build a new piece; styled labels get a random style of the split."""
        if label in STYLED:
            return STYLED[label](draw_style(label, split, rng), palette)
        return build_distractor(label, palette, rng)

    def fingerprint(self) -> str:
        """Return an empty string: the hash of the scene builders' code covers this furniture."""
        return ""

    def credits(self) -> Sequence[Credit]:
        """Return an empty sequence."""
        return ()


class Stock:
    """Stock of furniture of one home.

    Args:
        furniture: source of the pieces.
        split: split whose models are used.
        rng: random generator of the home.
    """

    def __init__(self, furniture: Furniture, split: Split, rng: np.random.Generator) -> None:
        self.rng = rng
        self.palette = Palette(rng)
        self._furniture, self._split = furniture, split

    def piece(self, label: str) -> Piece:
        """Return a new piece with a random style; place it several times for identical objects."""
        piece = self._furniture.piece(label, self._split, self.palette, self.rng)
        return piece or ProceduralFurniture().piece(label, self._split, self.palette, self.rng)

    def chance(self, probability: float) -> bool:
        """Return True with the given probability."""
        return bool(self.rng.random() < probability)
