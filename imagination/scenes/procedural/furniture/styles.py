"""Styles of furniture, drawn from the families of a split."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from imagination.scenes.procedural.furniture.families import FAMILIES, Family, Intervals
from imagination.scenes.source import Split

OPTION_PROBABILITIES: Mapping[str, float] = MappingProxyType({"arms": 0.2})
"""Probabilities of options other than 0.5: chairs with arms are rare because they hardly fit under tables."""


@dataclass(frozen=True)
class Style:
    """Style of a family: a value for each parameter, and the chosen options."""

    family: Family
    values: Mapping[str, float]
    options: frozenset[str]

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def __contains__(self, option: str) -> bool:
        return option in self.options

    @property
    def model(self) -> str:
        """Name of the family and a short hash of the style, for reports."""
        text = repr(
            (sorted((name, round(value, 6)) for name, value in self.values.items()), sorted(self.options))
        )
        return f"{self.family.name}/{hashlib.sha256(text.encode()).hexdigest()[:6]}"


def draw_style(label: str, split: Split, rng: np.random.Generator) -> Style:
    """Draw a style of a random family of a label."""
    families = [family for family in FAMILIES if family.label == label and split in family.splits]
    family = families[int(rng.integers(len(families)))]
    values = {}
    for name, cuts in family.intervals(split).items():
        widths = np.array([cut.high - cut.low for cut in cuts])
        cut = cuts[int(rng.choice(len(cuts), p=widths / widths.sum()))]
        values[name] = float(rng.uniform(cut.low, cut.high))
    return Style(
        family,
        values,
        frozenset(name for name in family.options if rng.random() < OPTION_PROBABILITIES.get(name, 0.5)),
    )


def families_of(split: Split) -> dict[str, dict[str, dict[str, Intervals]]]:
    """Return the content of a split: for each label and family the intervals of each parameter."""
    table: dict[str, dict[str, dict[str, Intervals]]] = {}
    for family in FAMILIES:
        if split in family.splits:
            table.setdefault(family.label, {})[family.name] = family.intervals(split)
    return table
