"""Training curves."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from imagination.reporting import style
from imagination.reporting.figures.scores import CELL_COLOURS, CELLS, _legend_below

Curve = tuple[Sequence[float], Sequence[float]]
"""Steps or epochs, and values."""


def draw_curves(curves: Mapping[str, Curve], title: str, across: str, up: str) -> Figure:
    """Lines of training: one for each name, coloured as its approach or kind of cell where it is one."""
    figure = Figure(figsize=(5.0, 3.2), layout="constrained")
    axis = figure.subplots()
    colours = {**style.colours(list(curves)), **CELL_COLOURS}
    for name, (steps, values) in curves.items():
        few = len(values) < 40
        axis.plot(
            steps, values, "o-" if few else "-", color=colours[name], markersize=4,
            label=CELLS.get(name, style.label(name)), linewidth=1.6 if few else 0.8,
        )  # fmt: skip
    axis.set_xlabel(across)
    axis.set_ylabel(up)
    axis.set_title(title)
    axis.grid(axis="y")
    if len(curves) > 1:
        _legend_below(figure, *axis.get_legend_handles_labels())
    return figure
