"""Tables in the paper's layout, a row for each approach, columns by cell width and category: CSV, Markdown, LaTeX."""

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from imagination.evaluation.approaches import NO_RIVALS
from imagination.evaluation.metrics import CONFIDENCE, bootstrap_iou, interval, iou, resample
from imagination.evaluation.records import Key
from imagination.reporting import paper_numbers
from imagination.reporting.load_run import Results, Runs, by_home
from imagination.reporting.style import label
from imagination.reporting.tables import pairs


class Column(NamedTuple):
    """A cell width in metres and a category."""

    cell_width: float
    category: str


class Cell(NamedTuple):
    """A value with its interval (not a number where there is none); `strong` ones are set in bold."""

    value: float
    low: float = math.nan
    high: float = math.nan
    strong: bool = False


class Line(NamedTuple):
    """One row: `None` where there is no such run."""

    name: str
    cells: list[Cell | None]


class Layout(NamedTuple):
    """A table.

    Attributes:
        stem: of its files.
        title, note: what it shows, and what must be known to read it.
        columns: of every line.
        blocks: lines under a heading each, e.g. ours and the paper's.
        digits: of values, as a format: ".3f".
    """

    stem: str
    title: str
    note: str
    columns: list[Column]
    blocks: list[tuple[str, list[Line]]]
    digits: str

    def text(self, value: float) -> str:
        """A value as it is printed."""
        return format(value, self.digits)

    def span(self, cell: Cell) -> str:
        """The interval of a cell as it is printed; empty where there is none."""
        return f"[{self.text(cell.low)}, {self.text(cell.high)}]" if math.isfinite(cell.low) else ""


Measure = Callable[[Int64[np.ndarray, "n 3"]], Float64[np.ndarray, " n"]]
"""A figure of merit of counts: IoU, or correct pixels."""

MEASURES: Mapping[str, Measure] = {"iou": iou, "correct_pixels": lambda counts: counts[..., 0].astype(float)}


def tables(results: Results) -> list[Layout]:
    """IoU, correct pixels and their differences in pairs; none where nothing was measured."""
    if not results.counts:
        return []
    columns = [Column(width, category) for width in results.cell_widths for category in results.categories]
    made = f"the {CONFIDENCE:.0%} interval over scenes ({results.resamples} bootstrap resamples) in brackets"
    best = "The best approach that is not told the truth is bold in each column of each block."
    cells = (
        f"Pixels are cells of {results.resolution:g} m here, of {paper_numbers.RESOLUTION:g} m in the paper."
    )
    return [
        Layout(
            "iou", "IoU of the global map", f"Pooled over runs, {made}. {best}", columns,
            _with_paper(results, columns, "iou", paper_numbers.IOU), ".3f",
        ),
        Layout(
            "correct_pixels", "Correctly predicted pixels", f"Summed over runs, {made}. {best} {cells}", columns,
            _with_paper(results, columns, "correct_pixels", paper_numbers.CORRECT_PIXELS), ".0f",
        ),
        *_by_cells(results, columns, best),
        *_in_pairs(results, columns),
    ]  # fmt: skip


def _by_cells(results: Results, columns: list[Column], best: str) -> list[Layout]:
    """IoU in the cells that a view of the run saw and in the others; none where mapping.csv is missing."""
    if not results.by_cells:
        return []
    blocks = []
    for place, block in enumerate(("Cells that a view saw", "Other cells")):
        lines = []
        for name in results.approaches:
            found = [results.by_cells.get(Key(name, at.category, at.cell_width)) for at in columns]
            lines.append(Line(label(name), [Cell(values[place]) if values else None for values in found]))
        blocks.append((block, strengthened(results.approaches, lines)))
    return [
        Layout("iou_by_cells", "IoU in seen and in unseen cells", f"Pooled over runs. {best}", columns, blocks,
               ".3f")
    ]  # fmt: skip


def _with_paper(
    results: Results, columns: list[Column], measure: str, published: paper_numbers.Numbers
) -> list[tuple[str, list[Line]]]:
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
    blocks = [(f"Ours, on {results.source}", strengthened(results.approaches, ours))]
    return [*blocks, (paper_numbers.SOURCE, strengthened(names, theirs))] if theirs else blocks


def _published(value: float | None) -> Cell | None:
    return None if value is None else Cell(value)


def cell_of(results: Results, key: Key, measure: str) -> Cell | None:
    """The measure of a row's runs with its interval; None where there is no such run."""
    runs = results.counts.get(key)
    if not runs:
        return None
    samples, value = bootstrap(results, runs, measure)
    return Cell(value, *interval(samples))


def bootstrap(results: Results, runs: Runs, measure: str) -> tuple[Float64[np.ndarray, " n"], float]:
    """The measure of each resample of scenes, and of all of them."""
    counts = by_home(runs)
    draws = resample(len(counts), results.resamples, results.seed)
    of = MEASURES[measure]
    samples = bootstrap_iou(counts, draws) if measure == "iou" else of(draws @ counts.sum(axis=1))
    return samples, float(of(counts.sum(axis=(0, 1))[None])[0])


def strengthened(names: Sequence[str], lines: Sequence[Line]) -> list[Line]:
    """Lines with the best value of each column in bold, unless all are equal, among approaches not told the truth."""
    fair = [place for place, name in enumerate(names) if name not in NO_RIVALS]
    changed = [list(line.cells) for line in lines]
    for column in range(len(lines[0].cells)):
        values = {place: cell.value for place in fair if (cell := lines[place].cells[column]) is not None}
        for place in values:
            cell = lines[place].cells[column]
            if cell is not None and min(values.values()) < cell.value == max(values.values()):
                changed[place][column] = cell._replace(strong=True)
    return [line._replace(cells=cells) for line, cells in zip(lines, changed, strict=True)]


def _in_pairs(results: Results, columns: list[Column]) -> list[Layout]:
    """Differences between approaches, over the runs that both have."""
    compared = pairs(results.approaches)
    if not compared:
        return []
    note = f"With {CONFIDENCE:.0%} intervals over scenes resampled in pairs; bold where the interval leaves out 0."
    return [
        Layout(
            f"paired_{measure}", title, note, columns,
            [("Ours", [_difference(results, pair, columns, measure) for pair in compared])], digits,
        )
        for measure, title, digits in (
            ("iou", "IoU in pairs", "+.3f"), ("correct_pixels", "Correct pixels in pairs", "+.0f"),
        )
    ]  # fmt: skip


def _difference(results: Results, pair: tuple[str, str], columns: list[Column], measure: str) -> Line:
    cells: list[Cell | None] = []
    for at in columns:
        ours, theirs = (results.counts.get(Key(name, at.category, at.cell_width), {}) for name in pair)
        both = [run for run in ours if run in theirs]
        if not both:
            cells.append(None)
            continue
        samples, value = bootstrap(results, {run: ours[run] for run in both}, measure)
        other_samples, other_value = bootstrap(results, {run: theirs[run] for run in both}, measure)
        low, high = interval(samples - other_samples)
        cells.append(Cell(value - other_value, low, high, strong=low > 0 or high < 0))
    return Line(" − ".join(map(label, pair)), cells)


def to_csv(layout: Layout) -> str:
    """The table with a column each for value and interval, e.g. chair_3m, chair_3m_low, chair_3m_high."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = [f"{at.category}_{at.cell_width:g}m" for at in layout.columns]
    writer.writerow(
        ["source", "approach", *(f"{head}{end}" for head in heads for end in ("", "_low", "_high"))]
    )
    for block, lines in layout.blocks:
        for name, cells in lines:
            values = [
                layout.text(value) if math.isfinite(value) else ""
                for cell in cells
                for value in (cell or Cell(math.nan))[:3]
            ]
            writer.writerow([block, name, *values])
    return text.getvalue()


def to_markdown(layout: Layout) -> str:
    """The table with its title and note; the interval stands behind each value."""
    heads = ["", *(f"{at.category}, {at.cell_width:g} m" for at in layout.columns)]
    lines = [f"**{layout.title}.** {layout.note}", "", _bars(heads), _bars(["---"] * len(heads))]
    for block, rows in layout.blocks:
        if len(layout.blocks) > 1:
            lines.append(_bars([f"*{block}*", *[""] * len(layout.columns)]))
        lines += [_bars([name, *(_marked(layout, cell) for cell in cells)]) for name, cells in rows]
    return "\n".join(lines) + "\n"


def _bars(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _marked(layout: Layout, cell: Cell | None) -> str:
    if cell is None:
        return "–"
    value = layout.text(cell.value)
    return f"{f'**{value}**' if cell.strong else value} {layout.span(cell)}".rstrip()


LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "−": "$-$",
}  # fmt: skip


def escaped(text: str) -> str:
    """Text as LaTeX prints it."""
    return "".join(LATEX.get(letter, letter) for letter in text)


def to_latex(layout: Layout) -> str:
    """The table as a `table*` of LaTeX with booktabs, cell widths over categories as in the paper."""
    groups: dict[float, list[str]] = {}
    for at in layout.columns:
        groups.setdefault(at.cell_width, []).append(at.category)
    over = "".join(
        f" & \\multicolumn{{{len(of)}}}{{c}}{{cell width {width:g} m}}" for width, of in groups.items()
    )
    rules, start = [], 2
    for of in groups.values():
        rules.append(f"\\cmidrule(lr){{{start}-{start + len(of) - 1}}}")
        start += len(of)
    lines = [
        r"% needs \usepackage{booktabs}",
        r"\begin{table*}",
        r"\centering",
        f"\\caption{{{escaped(f'{layout.title}. {layout.note}')}}}",
        f"\\label{{tab:{layout.stem.replace('_', '-')}}}",
        f"\\begin{{tabular}}{{l{'r' * len(layout.columns)}}}",
        r"\toprule",
        f"{over} \\\\",
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
    if cell is None:
        return "--"
    value = layout.text(cell.value)
    return f"$\\mathbf{{{value}}}$" if cell.strong else f"${value}$"
