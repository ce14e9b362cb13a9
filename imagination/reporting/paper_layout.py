"""Tables in the paper's layout (rows: approaches, columns: cell width and category) as CSV, Markdown and LaTeX."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import pandas as pd

from imagination.evaluation.approaches import CONTROLS
from imagination.evaluation.metrics import CONFIDENCE, iou
from imagination.reporting import paper_numbers
from imagination.reporting.load_run import Results
from imagination.reporting.statistics import (
    MIN_SCENES,
    Bootstrap,
    Estimate,
    counts_of,
    difference,
    estimate,
    select,
)
from imagination.reporting.style import label
from imagination.reporting.tables import pairs
from imagination.utils.tabular import csv_text, markdown_row, markdown_text


class Column(NamedTuple):
    """Column of a table: a cell width in metres and a category."""

    cell_width: float
    category: str


class Cell(NamedTuple):
    """Value with its uncertainty; `strong` values are printed in bold."""

    estimate: Estimate
    strong: bool = False

    @property
    def value(self) -> float:
        """Value without its uncertainty."""
        return self.estimate.value


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

    def spread(self, cell: Cell) -> str:
        """Format the deviation over seeds and the interval of a cell, as far as it has them."""
        parts, (_, low, high, seed_std) = [], cell.estimate
        if math.isfinite(seed_std):
            parts.append(f"± {format(seed_std, self.digits.lstrip('+'))}")
        if math.isfinite(low):
            parts.append(f"[{self.text(low)}, {self.text(high)}]")
        return " ".join(parts)


def tables(results: Results) -> list[Layout]:
    """Return the tables of IoU, correct pixels and their paired differences; empty without counts."""
    if results.trials.empty:
        return []
    columns = [Column(width, category) for width in results.cell_widths for category in results.categories]
    best = ""
    if any(enough_scenes(results, columns)):
        best = " The best approach that does not see the ground truth is bold in each column of each block."
    cells = (
        f"A pixel is a cell of {results.resolution:g} m here, of {paper_numbers.RESOLUTION:g} m in the paper."
    )
    spread = described_spread(results)
    return [
        Layout(
            "iou", "IoU of the global map", f"Pooled over trials, {spread}.{best}", columns,
            _with_paper(results, columns, "iou", paper_numbers.IOU), ".3f",
        ),
        Layout(
            "correct_pixels", "Correctly predicted pixels", f"Summed over trials, {spread}.{best} {cells}", columns,
            _with_paper(results, columns, "correct_pixels", paper_numbers.CORRECT_PIXELS), ".0f",
        ),
        *_by_cells(results, columns, best),
        *_paired_differences(results, columns),
    ]  # fmt: skip


def described_spread(results: Results) -> str:
    """Describe the numbers that follow a value."""
    resamples = results.bootstrap.resamples
    interval = f"the {CONFIDENCE:.0%} interval over scenes ({resamples} bootstrap resamples) in brackets"
    if len(results.scenes) < MIN_SCENES:
        interval = f"without intervals and best values, since there are fewer than {MIN_SCENES} scenes"
    seeds = len(results.seeds)
    return (
        f"mean and standard deviation (±) over {seeds} training seeds, {interval}" if seeds > 1 else interval
    )


def _by_cells(results: Results, columns: list[Column], best: str) -> list[Layout]:
    """Return the table of IoU in seen and in unseen cells."""
    heads = "Cells that a view saw", "Other cells"
    by_cells: list[list[Line]] = [[], []]
    for name in results.approaches:
        pairs_of_iou = [_iou_by_cells(results, name, at) for at in columns]
        for place, lines in enumerate(by_cells):
            cells = [values and Cell(Estimate(values[place])) for values in pairs_of_iou]
            lines.append(Line(label(name), cells))
    blocks = [
        (head, mark_best(results.approaches, lines, enough_scenes(results, columns)))
        for head, lines in zip(heads, by_cells, strict=True)
    ]
    note = f"Pooled over trials.{best}"
    return [Layout("iou_by_cells", "IoU in seen and in unseen cells", note, columns, blocks, ".3f")]


def _iou_by_cells(results: Results, approach: str, at: Column) -> tuple[float, float] | None:
    """Return the pooled IoU in seen and in unseen cells, means over seeds; None without trials."""
    trials = select(results.trials, approach, at.category, at.cell_width)
    if trials.empty:
        return None
    whole, seen = (counts_of(trials, suffix).sum(axis=1) for suffix in ("", "_seen"))
    return float(iou(seen).mean()), float(iou(whole - seen).mean())


def enough_scenes(results: Results, columns: Sequence[Column]) -> list[bool]:
    """Return for each column whether its category is in enough scenes to name a best approach."""
    scenes = results.trials.groupby("category")["scene"].nunique()
    return [bool(scenes[at.category] >= MIN_SCENES) for at in columns]


def _with_paper(
    results: Results, columns: list[Column], measure: str, published: paper_numbers.Numbers
) -> list[tuple[str, list[Line]]]:
    """Return the lines of our results and those that the paper published."""
    ours = [
        Line(label(name), [cell_of(results.trials, results.bootstrap, name, at, measure) for at in columns])
        for name in results.approaches
    ]
    names = [name for name in results.approaches if any((name, *at) in published for at in columns)]
    theirs = [
        Line(label(name), [_published(published.get((name, at.cell_width, at.category))) for at in columns])
        for name in names
    ]
    enough = enough_scenes(results, columns)
    blocks = [(f"Ours, on {results.source}", mark_best(results.approaches, ours, enough))]
    always = [True] * len(columns)
    return [*blocks, (paper_numbers.SOURCE, mark_best(names, theirs, always))] if theirs else blocks


def _published(value: float | None) -> Cell | None:
    return None if value is None else Cell(Estimate(value))


def cell_of(
    trials: pd.DataFrame, bootstrap: Bootstrap, approach: str, at: Column, measure: str = "iou"
) -> Cell | None:
    """Return the metric over the trials of an approach in a column; None without trials."""
    trials = select(trials, approach, at.category, at.cell_width)
    return None if trials.empty else Cell(estimate(counts_of(trials), bootstrap, measure))


def difference_cell(
    ours: pd.DataFrame, theirs: pd.DataFrame, bootstrap: Bootstrap, measure: str = "iou"
) -> Cell | None:
    """Return the paired difference of a metric, strong if its interval excludes 0; None without common trials."""
    found = difference(ours, theirs, bootstrap, measure)
    return found and Cell(found.estimate, found.estimate.low > 0 or found.estimate.high < 0)


def mark_best(names: Sequence[str], lines: Sequence[Line], enough: Sequence[bool]) -> list[Line]:
    """Mark the best value of each column as `strong` among approaches not in `CONTROLS`, unless all are equal.

    Args:
        names: names of the approaches of the lines.
        lines: rows of the table.
        enough: whether a column has enough scenes to name a best approach.
    """
    ranked = [place for place, name in enumerate(names) if name not in CONTROLS]
    marked = [list(line.cells) for line in lines]
    for column in (column for column, sufficient in enumerate(enough) if sufficient):
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
    note = f"Paired differences, {described_spread(results)}; bold if an interval excludes 0."
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
        ours, theirs = (select(results.trials, name, at.category, at.cell_width) for name in pair)
        cells.append(difference_cell(ours, theirs, results.bootstrap, measure))
    return Line(" − ".join(map(label, pair)), cells)


def to_csv(layout: Layout) -> str:
    """Return the table as CSV with columns for value, interval and deviation: chair_3m, chair_3m_low, and so on."""
    heads = [f"{at.category}_{at.cell_width:g}m" for at in layout.columns]
    ends = "", "_low", "_high", "_seed_std"
    rows = [["source", "approach", *(f"{head}{end}" for head in heads for end in ends)]]
    for block, lines in layout.blocks:
        for name, cells in lines:
            values = [
                layout.text(value) if math.isfinite(value) else ""
                for cell in cells
                for value in (cell.estimate if cell else Estimate(math.nan))
            ]
            rows.append([block, name, *values])
    return csv_text(rows)


def to_markdown(layout: Layout) -> str:
    """Return the table as Markdown with title and note; each interval follows its value."""
    heads = ["", *(f"{markdown_text(at.category)}, {at.cell_width:g} m" for at in layout.columns)]
    lines = [
        f"**{layout.title}.** {markdown_text(layout.note)}",
        "",
        *map(markdown_row, (heads, ["---"] * len(heads))),
    ]
    for block, rows in layout.blocks:
        if len(layout.blocks) > 1:
            lines.append(markdown_row([f"*{markdown_text(block)}*", *[""] * len(layout.columns)]))
        lines += [
            markdown_row([markdown_text(name), *(_marked(layout, cell) for cell in cells)])
            for name, cells in rows
        ]
    return "\n".join(lines) + "\n"


def _marked(layout: Layout, cell: Cell | None) -> str:
    """Format a cell as Markdown."""
    if cell is None:
        return "–"
    value = layout.text(cell.value)
    return f"{f'**{value}**' if cell.strong else value} {layout.spread(cell)}".rstrip()


LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "−": "$-$", "±": r"$\pm$",
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
            if any(cell and layout.spread(cell) for cell in cells):
                spans = [f"{{\\scriptsize {escaped(layout.spread(cell))}}}" if cell else "" for cell in cells]
                lines.append(" & ".join(["", *spans]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table*}"]) + "\n"


def _typeset(layout: Layout, cell: Cell | None) -> str:
    """Format a cell as LaTeX."""
    if cell is None:
        return "--"
    value = layout.text(cell.value)
    return f"$\\mathbf{{{value}}}$" if cell.strong else f"${value}$"
