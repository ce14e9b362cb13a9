"""How approaches are named and coloured in every figure and table, and the two themes figures are drawn in."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl

LABELS = {
    "seg_gt": "Seg. with GT",
    "seg_hrnet": "Seg. with HRNetV2",
    "imagination_seen": "Imagination (seen)",
    "seen_dilated": "Seen, dilated",
    "imagination": "Imagination",
    "rgb_shuffled": "RGB shuffled",
    "oracle": "Oracle",
}
"""The paper's names where it has one; an approach that is not here goes by its own."""

MEANINGS = {
    "seg_gt": "true first-person segmentation, projected by depth: ordinary semantic mapping with a perfect network",
    "seg_hrnet": "HRNetV2's first-person segmentation, projected by depth: ordinary semantic mapping",
    "imagination_seen": "the unit's prediction in cells that depth saw",
    "seen_dilated": "the prediction in cells that depth saw, not dilated by the unit but by the best kernel: "
    "does imagination do more than dilate?",
    "imagination": "the unit's whole valid prediction, also where nothing was seen",
    "rgb_shuffled": "imagination, each view with the colours of another one: does the unit look at them?",
    "oracle": "the truth within the imaginable area of the views: the most that can be imagined",
}
"""What the approaches are, for those who read the tables."""

COLOURS = {
    "seg_gt": "#0072b2",
    "seg_hrnet": "#56b4e9",
    "imagination_seen": "#e69f00",
    "seen_dilated": "#cc79a7",
    "imagination": "#d55e00",
    "rgb_shuffled": "#999999",
    "oracle": "#009e73",
}
"""The palette of Okabe and Ito (2008) with a darker yellow: people who see few colours can tell them apart."""

SPARE = ("#7f3c8d", "#2f4b7c", "#3969ac", "#80ba5a", "#a5673f")
"""Colours of other approaches, in their order."""

THEMES: dict[str, dict[str, Any]] = {
    "light": {"text": "#1c2430", "face": "#ffffff", "rim": "#8a94a3", "grid": "#dfe3e8"},
    "dark": {"text": "#e4e8ee", "face": "#171c24", "rim": "#6b7686", "grid": "#2c3542"},
}
"""Colours around the data; those of the page are the same."""


def label(name: str) -> str:
    """What an approach is called in figures and tables for people."""
    return LABELS.get(name, name)


def colours(names: Sequence[str]) -> dict[str, str]:
    """A colour for each approach, the same in every figure of a report."""
    others = [name for name in names if name not in COLOURS]
    spare = {name: SPARE[place % len(SPARE)] for place, name in enumerate(others)}
    return {name: COLOURS.get(name) or spare[name] for name in names}


@contextmanager
def theme(name: str) -> Iterator[None]:
    """Draw and save figures for a light or a dark page."""
    colour = THEMES[name]
    changes: Any = {  # matplotlib types each key by itself
        "figure.facecolor": colour["face"],
        "savefig.facecolor": colour["face"],
        "axes.facecolor": colour["face"],
        "axes.edgecolor": colour["rim"],
        "axes.grid": False,
        "axes.axisbelow": True,
        "axes.labelcolor": colour["text"],
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlesize": 10,
        "axes.labelsize": 9,
        "text.color": colour["text"],
        "xtick.color": colour["text"],
        "ytick.color": colour["text"],
        "xtick.labelsize": 8,
        "ytick.labelsize": 8,
        "grid.color": colour["grid"],
        "legend.frameon": False,
        "legend.fontsize": 8,
        "lines.linewidth": 1.6,
        "pdf.fonttype": 42,  # text stays text
    }
    with mpl.rc_context(changes):
        yield
