"""Tables in the paper's layout (rows: approaches, columns: cell width and category) as CSV, Markdown and LaTeX."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from imagination.evaluation.approaches import CONTROLS
from imagination.evaluation.metrics import CONFIDENCE, bootstrap_iou, interval, iou, resample
from imagination.evaluation.records import Key
from imagination.reporting import paper_numbers
from imagination.reporting.load_run import Results, TrialCounts, by_scene
from imagination.reporting.style import label
from imagination.reporting.tables import pairs
from imagination.utils.tabular import csv_text, markdown_row


class Column(NamedTuple):
    """Column of a table: a cell width in metres and a category."""

    cell_width: float
    category: str


class Cell(NamedTuple):
    """Value with its interval (NaN without one); `strong` values are printed in bold."""

    value: float
    low: float = math.nan
    high: float = math.nan
    strong: bool = False


class Line(NamedTuple):
    """Row of a table; a cell is None if there are no trials for it."""

    name: str
    cells: list[Cell | None]


class Layout(NamedTuple):
    """Table in the paper's layout.

    Attributes:
        stem: stem of its file names.
        title: title of the table.
        note: explanation for the reader.
        columns: columns of every line.
        blocks: headings with their lines, e.g. our results and the paper's.
        digits: format of the values, e.g. ".3f".
    """

    stem: str
    title: str
    note: str
    columns: list[Column]
    blocks: list[tuple[str, list[Line]]]
    digits: str

    def text(self, value: float) -> str:
        """Format a value."""
        return format(value, self.digits)

    def span(self, cell: Cell) -> str:
        """Format the interval of a cell; empty without an interval."""
        return f"[{self.text(cell.low)}, {self.text(cell.high)}]" if math.isfinite(cell.low) else ""


Measure = Callable[[Int64[np.ndarray, "n 3"]], Float64[np.ndarray, " n"]]
"""Metric of counts: IoU or correct pixels."""

MEASURES: Mapping[str, Measure] = {"iou": iou, "correct_pixels": lambda counts: counts[..., 0].astype(float)}
"""Metrics by name."""


def tables(results: Results) -> list[Layout]:
    """Return the tables of IoU, correct pixels and their paired differences; empty without counts."""
    if not results.counts:
        return []
    columns = [Column(width, category) for width in results.cell_widths for category in results.categories]
    intervals = (
        f"the {CONFIDENCE:.0%} interval over scenes ({results.resamples} bootstrap resamples) in brackets"
    )
    best = "The best approach that does not see the ground truth is bold in each column of each block."
    cells = (
        f"A pixel is a cell of {results.resolution:g} m here, of {paper_numbers.RESOLUTION:g} m in the paper."
    )
    return [
        Layout(
            "iou", "IoU of the global map", f"Pooled over trials, {intervals}. {best}", columns,
            _with_paper(results, columns, "iou", paper_numbers.IOU), ".3f",
        ),
        Layout(
            "correct_pixels", "Correctly predicted pixels", f"Summed over trials, {intervals}. {best} {cells}", columns,
            _with_paper(results, columns, "correct_pixels", paper_numbers.CORRECT_PIXELS), ".0f",
        ),
        *_by_cells(results, columns, best),
        *_paired_differences(results, columns),
    ]  # fmt: skip


def _by_cells(results: Results, columns: list[Column], best: str) -> list[Layout]:
    """Return the table of IoU in seen and in unseen cells; empty without mapping.csv."""
    if not results.by_cells:
        return []
    blocks = []
    for place, block in enumerate(("Cells that a view saw", "Other cells")):
        lines = []
        for name in results.approaches:
            pairs_of_iou = [results.by_cells.get(Key(name, at.category, at.cell_width)) for at in columns]
            cells = [Cell(values[place]) if values else None for values in pairs_of_iou]
            lines.append(Line(label(name), cells))
        blocks.append((block, mark_best(results.approaches, lines)))
    return [
        Layout("iou_by_cells", "IoU in seen and in unseen cells", f"Pooled over trials. {best}", columns, blocks,
               ".3f")
    ]  # fmt: skip


def _with_paper(
    results: Results, columns: list[Column], measure: str, published: paper_numbers.Numbers
) -> list[tuple[str, list[Line]]]:
    """Return the lines of our results and those that the paper published."""
    ours = [
        Line(
            label(name), [cell_of(results, Key(name, at.category, at.cell_width), measure) for at in columns]
        )
        for name in results.approaches
    ]
    names = [name for name in results.approaches if any((name, *at) in published for at in columns)]
    theirs = [
        Line(label(name), [_published(published.get((name, at.cell_width, at.category))) for at in columns])
        for name in names
    ]
    blocks = [(f"Ours, on {results.source}", mark_best(results.approaches, ours))]
    return [*blocks, (paper_numbers.SOURCE, mark_best(names, theirs))] if theirs else blocks


def _published(value: float | None) -> Cell | None:
    return None if value is None else Cell(value)


def cell_of(results: Results, key: Key, measure: str) -> Cell | None:
    """Return the metric over the trials of a row with its interval; None without trials."""
    trials = results.counts.get(key)
    if not trials:
        return None
    samples, value = bootstrap(results, trials, measure)
    return Cell(value, *interval(samples))


def bootstrap(results: Results, trials: TrialCounts, measure: str) -> tuple[Float64[np.ndarray, " n"], float]:
    """Return the metric of each bootstrap resample of scenes, and its value over all scenes."""
    counts = by_scene(trials)
    draws = resample(len(counts), results.resamples, results.seed)
    metric = MEASURES[measure]
    samples = bootstrap_iou(counts, draws) if measure == "iou" else metric(draws @ counts.sum(axis=1))
    return samples, float(metric(counts.sum(axis=(0, 1))[None])[0])


def mark_best(names: Sequence[str], lines: Sequence[Line]) -> list[Line]:
    """Mark the best value of each column as `strong` among approaches not in `CONTROLS`, unless all are equal."""
    ranked = [place for place, name in enumerate(names) if name not in CONTROLS]
    marked = [list(line.cells) for line in lines]
    for column in range(len(lines[0].cells)):
        values = {place: cell.value for place in ranked if (cell := lines[place].cells[column]) is not None}
        for place in values:
            cell = lines[place].cells[column]
            if cell is not None and min(values.values()) < cell.value == max(values.values()):
                marked[place][column] = cell._replace(strong=True)
    return [line._replace(cells=cells) for line, cells in zip(lines, marked, strict=True)]


def _paired_differences(results: Results, columns: list[Column]) -> list[Layout]:
    """Return the tables of differences between approaches over the trials that both have."""
    compared = pairs(results.approaches)
    if not compared:
        return []
    note = f"With {CONFIDENCE:.0%} intervals over scenes (paired bootstrap); bold if the interval excludes 0."
    return [
        Layout(
            f"paired_{measure}", title, note, columns,
            [("Ours", [_difference(results, pair, columns, measure) for pair in compared])], digits,
        )
        for measure, title, digits in (
            ("iou", "Paired differences of IoU", "+.3f"),
            ("correct_pixels", "Paired differences of correct pixels", "+.0f"),
        )
    ]  # fmt: skip


def _difference(results: Results, pair: tuple[str, str], columns: list[Column], measure: str) -> Line:
    """Return the row of the differences of one pair of approaches."""
    cells: list[Cell | None] = []
    for at in columns:
        ours, theirs = (results.counts.get(Key(name, at.category, at.cell_width), {}) for name in pair)
        shared = [trial for trial in ours if trial in theirs]
        if not shared:
            cells.append(None)
            continue
        samples, value = bootstrap(results, {trial: ours[trial] for trial in shared}, measure)
        other_samples, other_value = bootstrap(results, {trial: theirs[trial] for trial in shared}, measure)
        low, high = interval(samples - other_samples)
        cells.append(Cell(value - other_value, low, high, strong=low > 0 or high < 0))
    return Line(" − ".join(map(label, pair)), cells)


def to_csv(layout: Layout) -> str:
    """Return the table as CSV with columns for value and interval, e.g. chair_3m, chair_3m_low, chair_3m_high."""
    heads = [f"{at.category}_{at.cell_width:g}m" for at in layout.columns]
    rows = [["source", "approach", *(f"{head}{end}" for head in heads for end in ("", "_low", "_high"))]]
    for block, lines in layout.blocks:
        for name, cells in lines:
            values = [
                layout.text(value) if math.isfinite(value) else ""
                for cell in cells
                for value in (cell or Cell(math.nan))[:3]
            ]
            rows.append([block, name, *values])
    return csv_text(rows)


def to_markdown(layout: Layout) -> str:
    """Return the table as Markdown with title and note; each interval follows its value."""
    heads = ["", *(f"{at.category}, {at.cell_width:g} m" for at in layout.columns)]
    lines = [f"**{layout.title}.** {layout.note}", "", *map(markdown_row, (heads, ["---"] * len(heads)))]
    for block, rows in layout.blocks:
        if len(layout.blocks) > 1:
            lines.append(markdown_row([f"*{block}*", *[""] * len(layout.columns)]))
        lines += [markdown_row([name, *(_marked(layout, cell) for cell in cells)]) for name, cells in rows]
    return "\n".join(lines) + "\n"


def _marked(layout: Layout, cell: Cell | None) -> str:
    """Format a cell as Markdown."""
    if cell is None:
        return "–"
    value = layout.text(cell.value)
    return f"{f'**{value}**' if cell.strong else value} {layout.span(cell)}".rstrip()


LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "−": "$-$",
}  # fmt: skip
"""LaTeX commands of special characters."""


def escaped(text: str) -> str:
    """Escape the special characters of LaTeX."""
    return "".join(LATEX.get(letter, letter) for letter in text)


def to_latex(layout: Layout) -> str:
    """Return the table as a LaTeX `table*` with booktabs, with cell widths above categories as in the paper."""
    groups: dict[float, list[str]] = {}
    for at in layout.columns:
        groups.setdefault(at.cell_width, []).append(at.category)
    header = "".join(
        f" & \\multicolumn{{{len(names)}}}{{c}}{{cell width {width:g} m}}" for width, names in groups.items()
    )
    rules, start = [], 2
    for names in groups.values():
        rules.append(f"\\cmidrule(lr){{{start}-{start + len(names) - 1}}}")
        start += len(names)
    lines = [
        r"% needs \usepackage{booktabs}",
        r"\begin{table*}",
        r"\centering",
        f"\\caption{{{escaped(f'{layout.title}. {layout.note}')}}}",
        f"\\label{{tab:{layout.stem.replace('_', '-')}}}",
        f"\\begin{{tabular}}{{l{'r' * len(layout.columns)}}}",
        r"\toprule",
        f"{header} \\\\",
        "".join(rules),
        "".join(f" & {escaped(at.category)}" for at in layout.columns) + r" \\",
    ]
    for block, rows in layout.blocks:
        lines.append(r"\midrule")
        if len(layout.blocks) > 1:
            lines.append(
                f"\\multicolumn{{{len(layout.columns) + 1}}}{{l}}{{\\emph{{{escaped(block)}}}}} \\\\"
            )
        for name, cells in rows:
            lines.append(" & ".join([escaped(name), *(_typeset(layout, cell) for cell in cells)]) + r" \\")
            if any(cell and layout.span(cell) for cell in cells):
                spans = [f"{{\\scriptsize {layout.span(cell)}}}" if cell else "" for cell in cells]
                lines.append(" & ".join(["", *spans]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table*}"]) + "\n"


def _typeset(layout: Layout, cell: Cell | None) -> str:
    """Format a cell as LaTeX."""
    if cell is None:
        return "--"
    value = layout.text(cell.value)
    return f"$\\mathbf{{{value}}}$" if cell.strong else f"${value}$"
