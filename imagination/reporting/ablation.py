"""Content of a sweep's report: its jobs, and each ablation as a table and a plot."""

import shlex
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product

import pandas as pd

from imagination.evaluation.metrics import CONFIDENCE
from imagination.evaluation.single_views import ranked_by
from imagination.reporting import tables
from imagination.reporting.best_setting import (
    comparable,
    enough_scenes,
    same_ground_truth,
)
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
from imagination.reporting.load_run import Results
from imagination.reporting.load_sweep import GROUPED, Multirun, Setting, results_of
from imagination.reporting.paper_layout import Cell, Column, Layout, Line, cell_of, difference_cell
from imagination.reporting.statistics import (
    KEY,
    MIN_SCENES,
    difference,
    groups,
    select,
)
from imagination.reporting.style import label
from imagination.utils.tabular import Row, read_yaml, to_csv


def of_multirun(sweep: Multirun) -> Content:
    """Return the content of a sweep's report."""
    first = results_of(sweep.evaluated[0])
    problems = [
        f"job {job.number} ({_assignments(sweep.values(job))}): {job.state}; {job.reason}"
        for job in sweep.jobs
        if job.state != "complete"
    ]
    if len({str(results_of(job).config.get("program")) for job in sweep.evaluated}) > 1:
        problems.append("the jobs were trained by different code, so their results cannot be compared")
    keys = ", ".join(sweep.swept) or "nothing"
    complete = sum(job.state == "complete" for job in sweep.jobs)
    common = [
        (name, value) for name, value in facts(first)[1:] if name != "Seed" or "seed" not in sweep.swept
    ]
    properties = [("Swept", keys), ("Jobs", f"{len(sweep.jobs)}, {complete} complete"), *common]
    sections = [Section("Jobs", plain=(Plain("Swept values and state of each job", _rows(sweep)),))]
    if sweep.settings:
        sections.append(Section(
            "Ablation",
            f"Pooled IoU with {CONFIDENCE:.0%} intervals over scenes, and standard deviations over training seeds.",
            layouts=tuple(_layouts(sweep, first)),
            drawings=tuple(_drawings(sweep, first)),
        ))  # fmt: skip
    return Content(
        f"Sweep of {first.name}",
        [("Folder", str(sweep.folder.resolve())), *properties],
        problems,
        sections,
        _commands(sweep, first),
        as_yaml(first),
        {f"{name}.csv": to_csv(rows) for name, rows in setting_tables(sweep).items() if rows},
    )


def setting_tables(sweep: Multirun) -> dict[str, list[Row]]:
    """Return the rows of mapping.csv, mapping_seeds.csv and paired.csv of a sweep, with the swept keys first.

    paired.csv holds the differences of each setting from the first one, for each approach.
    """
    rows: dict[str, list[Row]] = {"mapping": [], "mapping_seeds": [], "paired": []}
    for setting in sweep.settings:
        trials, bootstrap = setting.trials, results_of(setting.jobs[0]).bootstrap
        for name, frame in (
            ("mapping", tables.mapping(trials, bootstrap)),
            ("mapping_seeds", tables.mapping_seeds(trials)),
        ):
            rows[name] += [setting.values | row for row in tables.text(frame)]
    for setting in sweep.settings[1:]:
        frame = _differences(sweep.settings[0], setting)
        rows["paired"] += [setting.values | row for row in tables.text(frame, tables.SIGNED)]
    return rows


def _differences(baseline: Setting, setting: Setting) -> pd.DataFrame:
    """Return the paired differences of a setting from the baseline for each approach, category and cell width."""
    rows = []
    theirs, bootstrap = baseline.trials, results_of(baseline.jobs[0]).bootstrap
    for key, ours in groups(setting.trials):
        found = difference(ours, select(theirs, *key), bootstrap, "iou")
        if found is not None and same_ground_truth(ours, select(theirs, *key)):
            rows.append(
                {
                    **dict(zip(KEY, key, strict=True)),
                    "compared_with": baseline.name,
                    **tables.difference_columns(found),
                    "seeds": found.seeds,
                    "scenes": found.scenes,
                }
            )
    return pd.DataFrame(rows)


def _rows(sweep: Multirun) -> list[Row]:
    """Return the table of the jobs."""
    return [
        {"job": job.number, **sweep.values(job), "state": job.state, "reason": job.reason}
        for job in sweep.jobs
    ]


def _layouts(sweep: Multirun, first: Results) -> Iterator[Layout]:
    """Yield the table of all settings, and that of their differences from the first one.

    With one setting, as in a sweep over seeds or cell widths, the lines of the table are the approaches.
    """
    columns, approaches = sweep.columns, sweep.approaches
    lines = {
        name: [
            Line(setting.name, [cell_of(setting.trials, first.bootstrap, name, at) for at in columns])
            for setting in sweep.settings
        ]
        for name in approaches
    }
    note = f"Pooled over trials; {_described_spread(sweep)}."
    if len(sweep.settings) == 1:
        block = [Line(label(name), lines[name][0].cells) for name in approaches]
        yield Layout("ablation", "IoU of the global map", note, columns, [("", block)], ".3f")
        return
    blocks = [(label(name), _mark_best_validated(sweep, name, columns, lines[name])) for name in approaches]
    note += (
        " In each block and category the setting with the highest IoU on validation scenes is bold; test scenes select "
        "nothing."
    )
    if not all(comparable(sweep, at) for at in columns):
        note += " The jobs have different ground truth, so their IoU cannot be compared."
    yield Layout("ablation", "IoU of the global map by swept value", note, columns, blocks, ".3f")
    yield from _paired_layout(sweep, columns, ranked_by(approaches), first)


def _paired_layout(sweep: Multirun, columns: list[Column], approach: str, first: Results) -> Iterator[Layout]:
    """Yield the table of the differences of each setting from the first one, unless no ground truth is the same."""
    baseline = sweep.settings[0]
    if not any(comparable(sweep, at) for at in columns):
        return
    lines = []
    for setting in sweep.settings[1:]:
        cells: list[Cell | None] = []
        for at in columns:
            ours, theirs = (
                select(each.trials, approach, at.category, at.cell_width) for each in (setting, baseline)
            )
            same = same_ground_truth(ours, theirs)
            cells.append(difference_cell(ours, theirs, first.bootstrap) if same else None)
        lines.append(Line(setting.name, cells))
    note = (
        f"{label(approach)}: paired differences from {baseline.name}; {_described_spread(sweep)}. Bold if the interval "
        "over scenes excludes 0."
    )
    title = "Paired differences of IoU between settings"
    yield Layout("paired_settings", title, note, columns, [("", lines)], "+.3f")


def _described_spread(sweep: Multirun) -> str:
    """Describe the numbers that follow a value."""
    several = any(len({results_of(job).seed for job in setting.jobs}) > 1 for setting in sweep.settings)
    seeds = "mean and standard deviation (±) over training seeds, " if several else ""
    return f"{seeds}intervals over scenes in brackets, if there are at least {MIN_SCENES}"


def _mark_best_validated(
    sweep: Multirun, approach: str, columns: Sequence[Column], lines: Sequence[Line]
) -> list[Line]:
    """Mark the setting with the highest IoU on validation scenes, unless all are equal or not comparable."""
    marked = [list(line.cells) for line in lines]
    for place, at in enumerate(columns):
        scores = [setting.validated(approach, at.category) for setting in sweep.settings]
        values = {
            row: value for row, value in enumerate(scores) if value is not None and lines[row].cells[place]
        }
        if comparable(sweep, at) and enough_scenes(sweep, at) and len(set(values.values())) > 1:
            for row, value in values.items():
                if value == max(values.values()) and (cell := lines[row].cells[place]):
                    marked[row][place] = cell._replace(strong=True)
    return [line._replace(cells=cells) for line, cells in zip(lines, marked, strict=True)]


def _drawings(sweep: Multirun, first: Results) -> Iterator[Drawing]:
    """Yield a figure for each category and swept key; see `_curves` for a sweep over cell widths.

    With one swept key the lines are the approaches. With several keys the lines are the values of the other keys, for
    the ranking approach.
    """
    keys = [key for key in sweep.swept if key not in GROUPED]
    if not keys:
        yield from _curves(sweep, first)
    approaches = sweep.approaches
    shown = [ranked_by(approaches)] if len(keys) > 1 else approaches
    for key, category in product(keys, dict.fromkeys(at.category for at in sweep.columns)):
        panels = {
            f"cell width {width:g} m": lines
            for width in sorted({at.cell_width for at in sweep.columns}, reverse=True)
            if (lines := _lines(sweep, key, Column(width, category), shown, first))
        }
        if not panels:
            continue  # no job has both the category and the approach
        approach = f" ({label(shown[0])})" if len(keys) > 1 else ""
        yield Drawing(
            f"ablation_{key}__{category}",
            f"{category}{approach}: pooled IoU over {key}.",
            partial(draw_ablation, panels, key, "pooled IoU"),
            wide=len(panels) > 1,
        )


def _curves(sweep: Multirun, first: Results) -> Iterator[Drawing]:
    """Yield the figure of IoU over cell width of a sweep with one setting: a panel for each category."""
    columns, (setting,) = sweep.columns, sweep.settings
    panels: dict[str, dict[str, list[Point]]] = {}
    for at, approach in product(columns, sweep.approaches):
        if (cell := cell_of(setting.trials, first.bootstrap, approach, at)) is not None:
            point = f"{at.cell_width:g}", cell.estimate
            panels.setdefault(at.category, {}).setdefault(approach, []).append(point)
    if len({at.cell_width for at in columns}) > 1:
        yield Drawing(
            "iou_over_cell_width",
            "Pooled IoU over the cell width.",
            partial(draw_ablation, panels, "cell width, m", "pooled IoU"),
            wide=len(panels) > 1,
        )


def _lines(
    sweep: Multirun, key: str, at: Column, approaches: Sequence[str], first: Results
) -> dict[str, list[Point]]:
    """Return the points of each line of a panel."""
    lines: dict[str, list[Point]] = {}
    for setting, approach in product(sweep.settings, approaches):
        others = _assignments({name: value for name, value in setting.values.items() if name != key})
        if (cell := cell_of(setting.trials, first.bootstrap, approach, at)) is not None:
            lines.setdefault(others or approach, []).append((setting.values[key], cell.estimate))
    return lines


def _commands(sweep: Multirun, first: Results) -> list[str]:
    """Return the commands of the training of evaluated networks, of the sweep and of the report."""
    report = report_command(sweep.folder)
    try:
        hydra = read_yaml(sweep.folder / "multirun.yaml")["hydra"]
        words = ["python", "-m", f"imagination.{hydra['job']['name']}", "-m", *hydra["overrides"]["task"]]
        command = shlex.join(words)
    except Exception:  # missing or damaged; a search writes no such file
        words = first.provenance.get("command", "").split()
        command = " ".join(word for word in words if "hydra.sweep.dir=" not in word)
        command = command if "imagination.train" in command or "imagination.evaluate" in command else ""
    return [*(trainings(first) if "ckpt" in first.config else []), *filter(None, [command]), report]


def _assignments(values: dict[str, str]) -> str:
    """Format values as key=value, separated by commas."""
    return ", ".join(f"{key}={value}" for key, value in values.items())
