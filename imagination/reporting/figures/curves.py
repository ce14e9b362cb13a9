"""Figures of training curves."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from imagination.reporting import style
from imagination.reporting.figures.scores import CELL_COLOURS, CELLS, legend_below

Curve = tuple[Sequence[float], Sequence[float]]
"""Steps or epochs, and values of a curve."""


def draw_curves(curves: Mapping[str, Curve], title: str, xlabel: str, ylabel: str) -> Figure:
    """Draw one line for each name, in the colour of the approach or subset of cells with this name."""
    figure = Figure(figsize=(5.0, 3.2), layout="constrained")
    axis = figure.subplots()
    colours = {**style.colours(list(curves)), **CELL_COLOURS}
    for name, (steps, values) in curves.items():
        few = len(values) < 40
        axis.plot(
            steps, values, "o-" if few else "-", color=colours[name], markersize=4,
            label=CELLS.get(name, style.label(name)), linewidth=1.6 if few else 0.8,
        )  # fmt: skip
    axis.set_xlabel(xlabel)
    axis.set_ylabel(ylabel)
    axis.set_title(title)
    axis.grid(axis="y")
    if len(curves) > 1:
        legend_below(figure, *axis.get_legend_handles_labels())
    return figure
