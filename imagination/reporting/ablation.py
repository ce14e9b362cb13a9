"""What a sweep's report tells: its members, and each ablation as a table and a plot."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product

from imagination.evaluation.metrics import CONFIDENCE, interval
from imagination.evaluation.records import Key
from imagination.evaluation.single_views import ranked_by
from imagination.reporting.content import Content, Drawing, Plain, Section, as_yaml, facts, trainings
from imagination.reporting.figures.scores import Point, draw_ablation
from imagination.reporting.load_run import Results, Runs
from imagination.reporting.load_sweep import Job, Multirun
from imagination.reporting.paper_layout import Cell, Column, Layout, Line, bootstrap, cell_of
from imagination.reporting.style import label
from imagination.utils.tabular import read_yaml


def of_multirun(sweep: Multirun) -> Content:
    """Everything that a sweep has to tell."""
    measured = [job for job in sweep.read if job.results and job.results.counts]
    first = _results([*measured, *sweep.read][0])
    problems = [
        f"member {job.number} ({_told(sweep.values(job))}) is {job.state}: {job.reason}"
        for job in sweep.jobs
        if job.state != "complete"
    ]
    keys = ", ".join(sweep.swept) or "nothing"
    done = sum(job.state == "complete" for job in sweep.jobs)
    told = [("Swept", keys), ("Members", f"{len(sweep.jobs)}, {done} complete"), *facts(first)[1:]]
    sections = [Section("Members", plain=(Plain("What was swept, and what came of it", _rows(sweep)),))]
    if measured and sweep.swept:
        sections.append(Section(
            "Ablation",
            f"Pooled IoU with {CONFIDENCE:.0%} intervals over scenes.",
            layouts=tuple(_layouts(sweep, measured)),
            drawings=tuple(_drawings(sweep, measured)),
        ))  # fmt: skip
    title = f"Sweep of {first.name}"
    return Content(
        title,
        [("Folder", str(sweep.folder)), *told],
        problems,
        sections,
        _commands(sweep, first),
        as_yaml(first),
    )


def _rows(sweep: Multirun) -> list[dict[str, str]]:
    return [
        {"member": each.number, **sweep.values(each), "state": each.state, "reason": each.reason}
        for each in sweep.jobs
    ]


def _layouts(sweep: Multirun, measured: Sequence[Job]) -> Iterator[Layout]:
    """One table, a block for each approach and a line for each member."""
    every = [key for each in measured for key in _results(each).counts]
    widths = sorted({key.cell_width for key in every}, reverse=True)
    categories = list(dict.fromkeys(key.category for key in every))
    columns = [Column(width, category) for width in widths for category in categories]
    blocks = []
    for approach in dict.fromkeys(key.approach for key in every):
        lines = [
            Line(
                _told(sweep.values(each)),
                [cell_of(_results(each), Key(approach, at.category, at.cell_width), "iou") for at in columns],
            )
            for each in measured
        ]
        blocks.append((label(approach), _best_validated(measured, approach, columns, lines)))
    note = (
        "Pooled over runs, with intervals over scenes; of each block and category what was best on validation scenes is "
        "bold, since test scenes choose nothing."
    )
    if any(len(_truths(measured, at)) > 1 for at in columns):
        note += (
            " Members are measured against different truths, so their IoU tells nothing of which is better."
        )
    yield Layout("ablation", "IoU of the global map by what was swept", note, columns, blocks, ".3f")


def _best_validated(
    measured: Sequence[Job], approach: str, columns: Sequence[Column], lines: Sequence[Line]
) -> list[Line]:
    """Lines with the member in bold whose IoU on validation scenes is highest, unless all are equal or truths differ."""
    changed = [list(line.cells) for line in lines]
    for place, at in enumerate(columns):
        found = [_results(each).validated.get((approach, at.category)) for each in measured]
        values = {
            row: value for row, value in enumerate(found) if value is not None and lines[row].cells[place]
        }
        if len(_truths(measured, at)) == 1 and len(set(values.values())) > 1:
            for row, value in values.items():
                if value == max(values.values()) and (cell := lines[row].cells[place]):
                    changed[row][place] = cell._replace(strong=True)
    return [line._replace(cells=cells) for line, cells in zip(lines, changed, strict=True)]


def _truths(measured: Sequence[Job], at: Column) -> set[tuple[tuple[str, int], ...]]:
    """What members are measured against in a column: the pixels of truth of each scene."""
    found = set()
    for each in measured:
        runs = [
            runs
            for key, runs in _results(each).counts.items()
            if (key.cell_width, key.category) == (at.cell_width, at.category)
        ]
        if runs:
            found.add(
                tuple(sorted({scene: int(pixels[2]) for (scene, _), pixels in runs[0].items()}.items()))
            )
    return found


def _drawings(sweep: Multirun, measured: Sequence[Job]) -> Iterator[Drawing]:
    """A figure for each category and each key that was swept.

    Lines are approaches where one key was swept, else what else was swept, for the approach that ranks.
    """
    categories = dict.fromkeys(key.category for each in measured for key in _results(each).counts)
    approaches = list(dict.fromkeys(key.approach for each in measured for key in _results(each).counts))
    for key, category in product(sweep.swept, categories):
        several = len(sweep.swept) > 1
        shown = [ranked_by(approaches)] if several else approaches
        panels = {
            title: lines
            for title, width in _panels(measured).items()
            if (lines := _lines(sweep, measured, key, category, shown, width))
        }
        if not panels:
            continue  # no member has both the category and the approach
        what = f" ({label(shown[0])})" if several else ""
        stem = "".join(letter if letter.isalnum() else "_" for letter in key)
        yield Drawing(
            f"ablation_{stem}_{category}",
            f"{category}{what}: pooled IoU over {key}.",
            partial(draw_ablation, panels, key, "pooled IoU"),
            wide=len(panels) > 1,
        )


def _panels(measured: Sequence[Job]) -> dict[str, float | None]:
    """Cell widths that all members have; where they have none in common, all widths of each together."""
    sets = [{key.cell_width for key in _results(each).counts} for each in measured]
    common = sorted(set.intersection(*sets), reverse=True)
    return {f"cell width {width:g} m": width for width in common} or {"all cell widths together": None}


def _lines(
    sweep: Multirun,
    measured: Sequence[Job],
    key: str,
    category: str,
    approaches: Sequence[str],
    width: float | None,
) -> dict[str, list[Point]]:
    lines: dict[str, list[Point]] = {}
    for each, approach in product(measured, approaches):
        values = sweep.values(each)
        rest = _told({other: value for other, value in values.items() if other != key})
        if (cell := _cell(_results(each), approach, category, width)) is not None:
            lines.setdefault(rest or approach, []).append((values[key], cell.value, cell.low, cell.high))
    return lines


def _cell(results: Results, approach: str, category: str, width: float | None) -> Cell | None:
    if width is not None:
        return cell_of(results, Key(approach, category, width), "iou")
    runs: Runs = {
        (scene, number + 1000 * place): pixels
        for place, at in enumerate(results.cell_widths)
        for (scene, number), pixels in results.counts.get(Key(approach, category, at), {}).items()
    }
    if not runs:
        return None
    samples, value = bootstrap(results, runs, "iou")
    return Cell(value, *interval(samples))


def _results(each: Job) -> Results:
    assert each.results is not None
    return each.results


def _commands(sweep: Multirun, first: Results) -> list[str]:
    """What an evaluation's networks were trained with, the sweep as its multirun.yaml has it, and the report."""
    report = shlex.join(["python", "-m", "imagination.report", str(sweep.folder)])
    try:
        asked = read_yaml(sweep.folder / "multirun.yaml")["hydra"]
        given = [text for text in asked["overrides"]["task"] if not text.startswith("sweep_dir=")]
        swept = shlex.join(["python", "-m", f"imagination.{asked['job']['name']}", "-m", *given])
    except Exception:  # missing or damaged
        told = str(first.provenance.get("command", "")).split()  # a search leaves no such file
        swept = " ".join(text for text in told if "sweep_dir=" not in text)
        swept = swept if "imagination.train" in swept or "imagination.evaluate" in swept else ""
    return [*(trainings(first) if "ckpt" in first.config else []), *filter(None, [swept]), report]


def _told(values: Mapping[str, str]) -> str:
    return ", ".join(f"{key}={value}" for key, value in values.items())
