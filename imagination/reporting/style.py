"""Labels and colours of approaches in figures and tables, and the light and dark themes of figures."""

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
"""Labels of approaches, those of the paper where it has one; any other approach is shown by its name."""

MEANINGS = {
    "seg_gt": "ground-truth first-person segmentation projected by depth: semantic mapping with a perfect network",
    "seg_hrnet": "first-person segmentation by HRNetV2 projected by depth: ordinary semantic mapping",
    "imagination_seen": "prediction of the unit in the cells that depth saw",
    "seen_dilated": "undilated prediction of the unit in the cells that depth saw, then dilated by the best kernel: "
    "tests whether imagination is more than dilation",
    "imagination": "valid prediction of the unit in seen and unseen cells",
    "rgb_shuffled": "imagination with the colour images swapped among views: tests whether the unit uses colour",
    "oracle": "ground truth within the imaginable area of the views: upper bound of imagination",
}
"""Explanations of the approaches for readers of the tables."""

COLOURS = {
    "seg_gt": "#0072b2",
    "seg_hrnet": "#56b4e9",
    "imagination_seen": "#e69f00",
    "seen_dilated": "#cc79a7",
    "imagination": "#d55e00",
    "rgb_shuffled": "#999999",
    "oracle": "#009e73",
}
"""Colours of approaches: the colour-blind safe palette of Okabe and Ito (2008) with a darker yellow."""

SPARE = ("#7f3c8d", "#2f4b7c", "#3969ac", "#80ba5a", "#a5673f")
"""Colours of other approaches, in this order."""

THEMES: dict[str, dict[str, Any]] = {
    "light": {"text": "#1c2430", "face": "#ffffff", "rim": "#8a94a3", "grid": "#dfe3e8"},
    "dark": {"text": "#e4e8ee", "face": "#171c24", "rim": "#6b7686", "grid": "#2c3542"},
}
"""Colours of text, background, axes and grid; the HTML page uses the same."""


def label(name: str) -> str:
    """Return the label of an approach in figures and tables."""
    return LABELS.get(name, name)


def colours(names: Sequence[str]) -> dict[str, str]:
    """Return a colour for each approach, the same in every figure of a report."""
    others = [name for name in names if name not in COLOURS]
    spare = {name: SPARE[place % len(SPARE)] for place, name in enumerate(others)}
    return {name: COLOURS.get(name) or spare[name] for name in names}


@contextmanager
def theme(name: str) -> Iterator[None]:
    """Apply the light or dark theme to figures that are drawn and saved in the context."""
    colour = THEMES[name]
    changes: Any = {  # matplotlib types each key separately
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
        "pdf.fonttype": 42,  # embeds TrueType fonts, so that text stays text
    }
    with mpl.rc_context(changes):
        yield
