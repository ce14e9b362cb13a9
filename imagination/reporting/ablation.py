"""Content of a sweep's report: its jobs, and each ablation as a table and a plot."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product

from imagination.evaluation.metrics import CONFIDENCE, interval
from imagination.evaluation.records import Key
from imagination.evaluation.single_views import ranked_by
from imagination.reporting.content import (
    Content,
    Drawing,
    Plain,
    Section,
    as_yaml,
    facts,
    report_command,
    trainings,
)
from imagination.reporting.figures.scores import Point, draw_ablation
from imagination.reporting.load_run import Results, TrialCounts
from imagination.reporting.load_sweep import Job, Multirun
from imagination.reporting.paper_layout import Cell, Column, Layout, Line, bootstrap, cell_of
from imagination.reporting.style import label
from imagination.utils.tabular import read_yaml


def of_multirun(sweep: Multirun) -> Content:
    """Return the content of a sweep's report."""
    evaluated = [job for job in sweep.readable if job.results and job.results.counts]
    first = _results([*evaluated, *sweep.readable][0])
    problems = [
        f"job {job.number} ({_assignments(sweep.values(job))}): {job.state}; {job.reason}"
        for job in sweep.jobs
        if job.state != "complete"
    ]
    keys = ", ".join(sweep.swept) or "nothing"
    complete = sum(job.state == "complete" for job in sweep.jobs)
    properties = [("Swept", keys), ("Jobs", f"{len(sweep.jobs)}, {complete} complete"), *facts(first)[1:]]
    sections = [Section("Jobs", plain=(Plain("Swept values and state of each job", _rows(sweep)),))]
    if evaluated and sweep.swept:
        sections.append(Section(
            "Ablation",
            f"Pooled IoU with {CONFIDENCE:.0%} intervals over scenes.",
            layouts=tuple(_layouts(sweep, evaluated)),
            drawings=tuple(_drawings(sweep, evaluated)),
        ))  # fmt: skip
    title = f"Sweep of {first.name}"
    return Content(
        title,
        [("Folder", str(sweep.folder)), *properties],
        problems,
        sections,
        _commands(sweep, first),
        as_yaml(first),
    )


def _rows(sweep: Multirun) -> list[dict[str, str]]:
    """Return the table of the jobs."""
    return [
        {"job": job.number, **sweep.values(job), "state": job.state, "reason": job.reason}
        for job in sweep.jobs
    ]


def _layouts(sweep: Multirun, jobs: Sequence[Job]) -> Iterator[Layout]:
    """Yield the table with a block for each approach and a line for each job."""
    keys = [key for job in jobs for key in _results(job).counts]
    widths = sorted({key.cell_width for key in keys}, reverse=True)
    categories = list(dict.fromkeys(key.category for key in keys))
    columns = [Column(width, category) for width in widths for category in categories]
    blocks = []
    for approach in dict.fromkeys(key.approach for key in keys):
        lines = [
            Line(
                _assignments(sweep.values(job)),
                [cell_of(_results(job), Key(approach, at.category, at.cell_width), "iou") for at in columns],
            )
            for job in jobs
        ]
        blocks.append((label(approach), _mark_best_validated(jobs, approach, columns, lines)))
    note = (
        "Pooled over trials, with intervals over scenes. In each block and category the job with the highest IoU on "
        "validation scenes is bold; test scenes select nothing."
    )
    if any(len(_gt_pixels(jobs, at)) > 1 for at in columns):
        note += " The jobs have different ground truth, so their IoU cannot be compared."
    yield Layout("ablation", "IoU of the global map by swept value", note, columns, blocks, ".3f")


def _mark_best_validated(
    jobs: Sequence[Job], approach: str, columns: Sequence[Column], lines: Sequence[Line]
) -> list[Line]:
    """Mark the job with the highest IoU on validation scenes, unless all are equal or their ground truth differs."""
    marked = [list(line.cells) for line in lines]
    for place, at in enumerate(columns):
        scores = [_results(job).validated.get((approach, at.category)) for job in jobs]
        values = {
            row: value for row, value in enumerate(scores) if value is not None and lines[row].cells[place]
        }
        if len(_gt_pixels(jobs, at)) == 1 and len(set(values.values())) > 1:
            for row, value in values.items():
                if value == max(values.values()) and (cell := lines[row].cells[place]):
                    marked[row][place] = cell._replace(strong=True)
    return [line._replace(cells=cells) for line, cells in zip(lines, marked, strict=True)]


def _gt_pixels(jobs: Sequence[Job], at: Column) -> set[tuple[tuple[str, int], ...]]:
    """Return the distinct ground truths of the jobs in a column, as pixels of each scene."""
    distinct = set()
    for job in jobs:
        trials = next(
            (
                trials
                for key, trials in _results(job).counts.items()
                if (key.cell_width, key.category) == (at.cell_width, at.category)
            ),
            {},
        )
        if trials:
            pixels = {scene: int(counts[2]) for (scene, _), counts in trials.items()}
            distinct.add(tuple(sorted(pixels.items())))
    return distinct


def _drawings(sweep: Multirun, jobs: Sequence[Job]) -> Iterator[Drawing]:
    """Yield a figure for each category and swept key.

    With one swept key the lines are the approaches. With several keys the lines are the values of the other keys, for
    the ranking approach.
    """
    categories = dict.fromkeys(key.category for job in jobs for key in _results(job).counts)
    approaches = list(dict.fromkeys(key.approach for job in jobs for key in _results(job).counts))
    for key, category in product(sweep.swept, categories):
        several = len(sweep.swept) > 1
        shown = [ranked_by(approaches)] if several else approaches
        panels = {
            title: lines
            for title, width in _panels(jobs).items()
            if (lines := _lines(sweep, jobs, key, category, shown, width))
        }
        if not panels:
            continue  # no job has both the category and the approach
        approach = f" ({label(shown[0])})" if several else ""
        stem = "".join(letter if letter.isalnum() else "_" for letter in key)
        yield Drawing(
            f"ablation_{stem}_{category}",
            f"{category}{approach}: pooled IoU over {key}.",
            partial(draw_ablation, panels, key, "pooled IoU"),
            wide=len(panels) > 1,
        )


def _panels(jobs: Sequence[Job]) -> dict[str, float | None]:
    """Return the cell widths common to all jobs by panel title; without common widths one panel of all widths."""
    sets = [{key.cell_width for key in _results(job).counts} for job in jobs]
    common = sorted(set.intersection(*sets), reverse=True)
    return {f"cell width {width:g} m": width for width in common} or {"all cell widths together": None}


def _lines(
    sweep: Multirun,
    jobs: Sequence[Job],
    key: str,
    category: str,
    approaches: Sequence[str],
    width: float | None,
) -> dict[str, list[Point]]:
    """Return the points of each line of a panel."""
    lines: dict[str, list[Point]] = {}
    for job, approach in product(jobs, approaches):
        values = sweep.values(job)
        others = _assignments({other: value for other, value in values.items() if other != key})
        if (cell := _cell(_results(job), approach, category, width)) is not None:
            lines.setdefault(others or approach, []).append((values[key], cell.value, cell.low, cell.high))
    return lines


def _cell(results: Results, approach: str, category: str, width: float | None) -> Cell | None:
    """Return the pooled IoU at a cell width, or over all cell widths if it is None."""
    if width is not None:
        return cell_of(results, Key(approach, category, width), "iou")
    trials: TrialCounts = {
        (scene, number + 1000 * place): pixels
        for place, at in enumerate(results.cell_widths)
        for (scene, number), pixels in results.counts.get(Key(approach, category, at), {}).items()
    }
    if not trials:
        return None
    samples, value = bootstrap(results, trials, "iou")
    return Cell(value, *interval(samples))


def _results(job: Job) -> Results:
    assert job.results is not None
    return job.results


def _commands(sweep: Multirun, first: Results) -> list[str]:
    """Return the commands of the training of evaluated networks, of the sweep and of the report."""
    report = report_command(sweep.folder)
    try:
        hydra = read_yaml(sweep.folder / "multirun.yaml")["hydra"]
        words = ["python", "-m", f"imagination.{hydra['job']['name']}", "-m", *hydra["overrides"]["task"]]
        command = shlex.join(words)
    except Exception:  # missing or damaged; a search writes no such file
        words = str(first.provenance.get("command", "")).split()
        command = " ".join(word for word in words if "hydra.sweep.dir=" not in word)
        command = command if "imagination.train" in command or "imagination.evaluate" in command else ""
    return [*(trainings(first) if "ckpt" in first.config else []), *filter(None, [command]), report]


def _assignments(values: Mapping[str, str]) -> str:
    """Format values as key=value, separated by commas."""
    return ", ".join(f"{key}={value}" for key, value in values.items())
