"""What one home's furniture is taken from: styles of its split in the finishes of its palette."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.procedural.armchairs import build_armchair
from imagination.scenes.procedural.beds import build_bed
from imagination.scenes.procedural.chairs import build_chair
from imagination.scenes.procedural.desks import build_desk
from imagination.scenes.procedural.distractors import BUILDERS, build_distractor
from imagination.scenes.procedural.low_tables import build_low_table
from imagination.scenes.procedural.office_chairs import build_office_chair
from imagination.scenes.procedural.palette import Palette
from imagination.scenes.procedural.pieces import Piece
from imagination.scenes.procedural.styles import Style, draw_style
from imagination.scenes.procedural.tables import build_dining_table
from imagination.scenes.scene import Split

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


class Stock:
    """Makes pieces for one home.

    Args:
        split: whose styles are used.
        rng: of the home.
    """

    def __init__(self, split: Split, rng: np.random.Generator) -> None:
        self.rng = rng
        self.palette = Palette(rng)
        self._split = split

    def piece(self, label: str) -> Piece:
        """A new piece, of a style of its own; place it several times for several of the same."""
        if label in STYLED:
            return STYLED[label](draw_style(label, self._split, self.rng), self.palette)
        return build_distractor(label, self.palette, self.rng)

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return bool(self.rng.random() < probability)
