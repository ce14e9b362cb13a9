"""Content of the report of one run: tables, figures and commands, independent of the page format."""

import shlex
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import yaml
from matplotlib.figure import Figure

from imagination.config.overrides import assignment
from imagination.evaluation.read_records import ConfusionCounts
from imagination.evaluation.single_views import CELLS, FILE, MIN_LABEL, ranked_by
from imagination.reporting import mapping_report, paper_layout, training_curves
from imagination.reporting.figures import maps
from imagination.reporting.figures.curves import draw_curves
from imagination.reporting.figures.scores import draw_distribution, draw_precision_recall, draw_reliability
from imagination.reporting.figures.views import draw_single_views
from imagination.reporting.incomplete_run import missing_maps
from imagination.reporting.load_run import Results
from imagination.reporting.paper_layout import Layout
from imagination.reporting.style import MEANINGS, label
from imagination.runs import sweep_jobs
from imagination.runs.command_line import command_line
from imagination.utils.tabular import Row, parse_csv

PRIMARY_TABLES = ("mapping.csv", "mapping_seeds.csv", "paired.csv")
"""Files whose content other sections of the report show."""

TITLES = {
    "ego.csv": "Single views of test scenes: the unit's scores",
    "training.csv": "Networks: training data and IoU on single views",
    "furniture.csv": "Scenes with known and with unseen furniture",
    "mapping_details.csv": "Global maps: thresholds, areas and IoU by cells and order",
    "credits.csv": "Credits",
}
"""Titles of further tables; the title of any other table is its file name."""

MAX_ROWS = 200
"""Maximum number of rows of a further table in the report."""


class Drawing(NamedTuple):
    """Figure of a report: name, caption and drawing function; `wide` figures keep their size on a phone."""

    stem: str
    caption: str
    draw: Callable[[], Figure]
    wide: bool = False


class Plain(NamedTuple):
    """Table with the rows of a file."""

    title: str
    rows: list[Row]


class Section(NamedTuple):
    """Section of a report."""

    title: str
    note: str = ""
    layouts: tuple[Layout, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    plain: tuple[Plain, ...] = ()


class Content(NamedTuple):
    """Content of a report.

    Attributes:
        title: name of the run or sweep.
        facts: properties of the run as pairs of name and value.
        problems: messages on missing or damaged parts.
        sections: sections with tables and figures.
        commands: commands that reproduce the results and the report.
        config: resolved config as YAML.
        tables: contents of further files in tables/ by name.
    """

    title: str
    facts: list[tuple[str, str]]
    problems: list[str]
    sections: list[Section]
    commands: list[str]
    config: str
    tables: Mapping[str, str] = {}


def of_run(results: Results) -> Content:
    """Return the content of a run's report."""
    tables = mapping_report.table_files(results) if results.has_records else {}
    sections = [
        Section("Global maps", layouts=tuple(paper_layout.tables(results)), plain=tuple(_meanings(results))),
        Section(
            "Distributions over trials",
            "A trial is one viewpoint set of one scene. Boxes span the quartiles, whiskers extend to the last trial "
            "within 1.5 times the interquartile range, dots are trials.",
            drawings=tuple(_distributions(results)),
        ),
        Section("Whole maps", drawings=tuple(_maps(results))),
        Section("Single views", _ranking(results), drawings=tuple(_single_views(results))),
        Section(
            "Precision, recall and reliability",
            "Rings mark the thresholds selected on validation scenes. Reliability leaves out cells with a score below "
            ".01.",
            drawings=tuple(_scores(results)),
        ),
        Section("Training", drawings=tuple(_training(results))),
        Section("More tables", plain=tuple(_further(results, tables))),
    ]
    filled = [section for section in sections if section.layouts or section.drawings or section.plain]
    return Content(
        results.name,
        facts(results),
        results.all_problems,
        filled,
        commands(results),
        as_yaml(results),
        tables,
    )


def facts(results: Results) -> list[tuple[str, str]]:
    """Return the properties of the run and of the machine."""
    config, about, origin = results.config, results.about, results.provenance
    version = f"imagination {origin['version']}, commit {origin['commit'] or 'unknown'}" if origin else ""
    properties = {
        "Folder": str(results.folder.resolve()),
        "Categories": ", ".join(map(str, config.get("unit_categories") or [])),
        "Scenes": f"{results.source}, {len(results.scenes)} of the test split",
        "Resolution": f"{results.resolution:g} m per cell",
        "Approaches left out": ", ".join(results.left_out) if len(results.trials) else "",
        "Training seeds" if len(results.seeds) > 1 else "Seed": ", ".join(map(str, results.seeds)),
        "Date": origin.get("date", ""),
        "Version": version,
        "Processor": origin.get("processor", ""),
        "Precision": about.get("precision", ""),
        "Evaluation took": f"{sum(part.about['seconds'] for part in results.parts):.0f} s" if about else "",
        "Sensor": about.get("sensor", ""),
    }
    return [(name, value) for name, value in properties.items() if value]


def commands(results: Results) -> list[str]:
    """Return the commands that reproduce the run with the packages pinned in requirements.lock."""
    evaluated = [part.provenance.get("command", "") for part in results.parts]
    others = [command for command in evaluated if command and "imagination.train" not in command]
    return [*trainings(results), *others, report_command(results.folder)]


def report_command(folder: Path) -> str:
    """Return the command that writes the report on a results folder."""
    return command_line("report", [assignment("folder", str(folder))])


def trainings(results: Results) -> list[str]:
    """Return the commands that trained the networks."""
    return [command for run in results.trained if (command := _training_of(run))]


def _training_of(run: Results) -> str:
    """Return the command of a training.

    This is the recorded command, or the overrides of a run that was resumed, is a sweep's job or did not end.
    """
    command = run.provenance.get("command", "")
    in_sweep = (run.folder.parent / sweep_jobs.FILE).is_file()
    resumed = any(key in command for key in ("resume=", "ckpt_path="))
    if "imagination.train" in command and not in_sweep and not resumed:
        return command
    overrides = [str(text) for text in run.config.get("choices") or []]
    return shlex.join(["python", "-m", "imagination.train", *overrides]) if overrides else ""


def as_yaml(results: Results) -> str:
    """Return the resolved config as YAML, with the keys in the order of its file."""
    return yaml.safe_dump(results.config, sort_keys=False, allow_unicode=True)


def _meanings(results: Results) -> Iterator[Plain]:
    """Yield the table that explains the approaches."""
    rows = [
        {"approach": label(name), "meaning": MEANINGS[name]}
        for name in results.approaches
        if name in MEANINGS
    ]
    if rows:
        yield Plain("Approaches", rows)


def _distributions(results: Results) -> Iterator[Drawing]:
    """Yield box plots over trials."""
    for measure, name in (("iou", "IoU"), ("correct_pixels", "Correctly predicted pixels")):
        for category in results.categories:
            yield Drawing(
                f"distribution_{measure}_{category}",
                f"{name} of each trial by approach and cell width, {category}.",
                partial(draw_distribution, results.trials, category, measure),
            )


def _maps(results: Results) -> Iterator[Drawing]:
    """Yield the figures of saved maps; without saved maps report the problem."""
    if not results.maps:
        if len(results.trials):
            results.problems.append("maps/ is missing: maps, viewpoints, precision and recall are left out")
        return
    results.problems += missing_maps(results.trials, results.maps)
    for category in results.categories:
        widths = [width for width in results.cell_widths if maps.typical(results.maps, category, width)]
        ranking = label(ranked_by(results.approaches))
        for width in widths[-1:]:
            yield Drawing(
                f"maps_{category}",
                f"Maps of {category} at a cell width of {width:g} m: the trial with the median IoU of {ranking}.",
                partial(maps.draw_typical, results.maps, category, [width]),
                wide=True,
            )
    yield Drawing(
        "viewpoints",
        "Sparse viewpoints (Algorithm 1) and their headings, on the map of the scene with most viewpoints.",
        partial(maps.draw_viewpoints, results.maps),
        wide=True,
    )


def _ranking(results: Results) -> str:
    """Return the note on the selection of single views."""
    views, _ = results.single_views
    if not views:
        return ""
    return (
        f"The best, the median and the worst view of the test scenes by IoU of "
        f"{label(ranked_by(list(views[0].predicted)))} with V_label, among views with a label of at least "
        f"{MIN_LABEL:g} m²; ties go to the largest label. Each approach uses this view alone, with the threshold of "
        "its global map. The triangle is the robot, which faces up."
    )


def _single_views(results: Results) -> Iterator[Drawing]:
    """Yield the figures of single views."""
    views, resolution = results.single_views
    if not views and len(results.trials):
        results.problems.append(f"{FILE} is missing or empty: single views are left out")
    for category in dict.fromkeys(view.category for view in views):
        shown = [view for view in views if view.category == category]
        yield Drawing(
            f"single_{category}",
            f"Predictions from single views, {category}.",
            partial(draw_single_views, shown, resolution),
            wide=True,
        )


def _scores(results: Results) -> Iterator[Drawing]:
    """Yield the figures of precision, recall and reliability."""
    selected: dict[tuple[str, str], float] = {}
    if results.maps:
        first = results.maps[0]
        selected = {
            (name, category): first.threshold[place, layer].item() / 100
            for place, name in enumerate(first.approaches)
            for layer, category in enumerate(first.categories)
        }
    pooled, views = maps.counts_by_threshold(results.maps), results.view_counts
    by_approach = {
        (name, category): counts
        for (name, part, category), counts in views.items()
        if part == "all" and name != "network"
    }
    network = {
        (part, category): counts for (name, part, category), counts in views.items() if name == "network"
    }
    for stem, source, groups in (("maps", "global maps", pooled), ("views", "single views", by_approach)):
        for category, lines in _by_category(groups).items():
            thresholds = {name: value for (name, other), value in selected.items() if other == category}
            yield Drawing(
                f"precision_recall_{stem}_{category}",
                f"Precision over recall of {source}, {category}: all trials pooled, at every threshold.",
                partial(draw_precision_recall, lines, thresholds, f"{category}, {source}"),
            )
    for category, lines in _by_category(pooled).items():
        yield Drawing(
            f"reliability_maps_{category}",
            f"Reliability of the scores of global maps before the threshold, {category}.",
            partial(draw_reliability, lines, f"{category}, global maps"),
        )
    for category, lines in _by_category(network).items():
        ordered = {part: lines[part] for part in CELLS if part in lines}
        yield Drawing(
            f"reliability_network_{category}",
            f"Reliability of the network's probabilities in single views, {category}.",
            partial(draw_reliability, ordered, f"{category}, the network in single views"),
        )


def _by_category(groups: Mapping[tuple[str, str], ConfusionCounts]) -> dict[str, dict[str, ConfusionCounts]]:
    """Group counts by name and category into counts by category, then by name."""
    by_category: dict[str, dict[str, ConfusionCounts]] = {}
    for (name, category), counts in groups.items():
        by_category.setdefault(category, {})[name] = counts
    return by_category


def _charts(results: Results) -> list[training_curves.Chart]:
    """Return the training curves of a run, or those of an evaluation's networks in common charts."""
    logged = [(run, run.folder / training_curves.FOLDER) for run in results.trained]
    logged = [(run, folder) for run, folder in logged if folder.is_dir()]
    if results.trained != [results]:
        curves = [(run.name, run.kind, training_curves.read(folder)) for run, folder in logged]
        return training_curves.compared(curves)
    charts = [chart for _, folder in logged for chart in training_curves.charts(training_curves.read(folder))]
    if logged and not charts:
        results.problems.append(
            f"{training_curves.FOLDER}/ contains no curves: its event files are missing or damaged"
        )
    return charts


def _training(results: Results) -> Iterator[Drawing]:
    """Yield the figures of training curves."""
    for chart in _charts(results):
        yield Drawing(
            chart.stem,
            f"{chart.title} over optimizer steps.",
            partial(draw_curves, chart.curves, chart.title, "optimizer step", chart.ylabel),
        )


def _further(results: Results, tables: Mapping[str, str]) -> Iterator[Plain]:
    """Yield the tables that no other section shows: those made from the records, and those of other writers.

    Args:
        results: results folder.
        tables: contents of the tables made from the records by file name.
    """
    rows = {name: parse_csv(text) for name, text in tables.items() if name.endswith(".csv")}
    for path in sorted((results.folder / "tables").glob("*.csv")):
        # written by an earlier report
        from_report = path.name.startswith(("iou", "correct_pixels.", "paired_"))
        if path.name not in rows and not from_report:
            rows[path.name] = results.table(path.name)
    for name in sorted(rows.keys() - set(PRIMARY_TABLES)):
        if 0 < len(rows[name]) <= MAX_ROWS:
            yield Plain(TITLES.get(name, name), rows[name])
