"""What a report shows of one run: tables, figures and how to make it again, apart from how a page is set."""

import re
import shlex
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import NamedTuple

import yaml
from matplotlib.figure import Figure

from imagination.evaluation.records import SCENES
from imagination.evaluation.single_views import CELLS, FILE, MIN_LABEL, TABLE, ranked_by
from imagination.reporting import paper_layout, training_curves
from imagination.reporting.figures import maps
from imagination.reporting.figures.curves import draw_curves
from imagination.reporting.figures.scores import draw_distribution, draw_precision_recall, draw_reliability
from imagination.reporting.figures.views import draw_singles
from imagination.reporting.load_run import ConfusionCounts, Results, Row, missing_maps
from imagination.reporting.paper_layout import Layout
from imagination.reporting.style import MEANINGS, label
from imagination.runs import sweep_jobs

TOLD = ("mapping.csv", "paired.csv", "trials.csv", SCENES, TABLE)
"""Tables that other parts of the report are made of."""

TITLES = {
    "ego.csv": "Single views of test scenes: the unit's scores",
    "training.csv": "Networks: what they were trained on, and how well they do on single views",
    "furniture.csv": "Scenes with known and with unseen furniture",
}
"""Of further tables; others go by their file's name."""

MAX_ROWS = 200
"""Of a further table; longer ones stay in their files."""


class Drawing(NamedTuple):
    """A figure: its name, what it shows, and what draws it; `wide` ones keep their size on a phone."""

    stem: str
    caption: str
    draw: Callable[[], Figure]
    wide: bool = False

    @property
    def file(self) -> str:
        """Name of its files without their endings: categories come from tables, and may hold anything."""
        return re.sub(r"[^\w.+-]", "_", self.stem)[:50]


class Plain(NamedTuple):
    """A table as it stands in a file."""

    title: str
    rows: list[Row]


class Section(NamedTuple):
    """A part of a report."""

    title: str
    note: str = ""
    layouts: tuple[Layout, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    plain: tuple[Plain, ...] = ()


class Content(NamedTuple):
    """A report.

    Attributes:
        title: of the run or sweep.
        facts: what it is, in pairs.
        problems: what is missing or damaged.
        sections: tables and figures.
        commands: that make it again.
        config: resolved, as YAML.
    """

    title: str
    facts: list[tuple[str, str]]
    problems: list[str]
    sections: list[Section]
    commands: list[str]
    config: str


def of_run(results: Results) -> Content:
    """Everything that a run's folder has to tell."""
    made = [
        Section("Global maps", layouts=tuple(paper_layout.tables(results)), plain=tuple(_meanings(results))),
        Section(
            "Distributions over runs",
            "A run is one scene and viewpoint set. Boxes span the quartiles, whiskers reach the last run within "
            "1.5 times that, dots are runs.",
            drawings=tuple(_distributions(results)),
        ),
        Section("Whole maps", drawings=tuple(_maps(results))),
        Section("Single predictions", _ranking(results), drawings=tuple(_singles(results))),
        Section(
            "Precision, recall and reliability",
            "Rings mark the thresholds chosen on validation scenes. Cells with a score below .01 are left out of "
            "reliability.",
            drawings=tuple(_scores(results)),
        ),
        Section("Training", drawings=tuple(_training(results))),
        Section("More tables", plain=tuple(_further(results))),
    ]
    kept = [section for section in made if section.layouts or section.drawings or section.plain]
    return Content(results.name, facts(results), results.problems, kept, commands(results), as_yaml(results))


def facts(results: Results) -> list[tuple[str, str]]:
    """What the run is, and on what it ran."""
    config, origin = results.config, results.provenance
    found = {
        "Folder": str(results.folder),
        "Categories": ", ".join(map(str, config.get("unit_categories") or [])),
        "Scenes": f"{results.source}, {len(results.scenes)} of the test split",
        "Resolution": f"{results.resolution:g} m per cell",
        "Approaches left out": ", ".join(results.left_out) if results.counts else "",
        "Seed": str(config.get("seed", "?")),
        "Hardware": str(origin.get("hardware", "")),
        "Evaluation took": f"{float(origin['seconds']):.0f} s" if "seconds" in origin else "",
        "Sensor": str(origin.get("sensor", "")),
    }
    return [(name, value) for name, value in found.items() if value]


def commands(results: Results) -> list[str]:
    """How the run is made again, with the packages that requirements.lock pins."""
    made, told = trainings(results), str(results.provenance.get("command", ""))
    if told and "imagination.train" not in told:
        made.append(told)
    return [*made, shlex.join(["python", "-m", "imagination.report", str(results.folder)])]


def trainings(results: Results) -> list[str]:
    """The commands that trained the networks."""
    return [command for run in results.trained if (command := _training_of(run))]


def _training_of(run: Results) -> str:
    """As it was given; what was chosen, of a run that was resumed, was a sweep's member or did not end."""
    told = str(run.provenance.get("command", ""))
    alone = not (run.folder.parent / sweep_jobs.FILE).is_file()
    if alone and "imagination.train" in told and not any(mark in told for mark in ("resume=", "ckpt_path=")):
        return told
    chosen = [str(text) for text in run.config.get("choices") or []]
    return shlex.join(["python", "-m", "imagination.train", *chosen]) if chosen else ""


def as_yaml(results: Results) -> str:
    """The resolved config, keys in the order of its file."""
    return yaml.safe_dump(results.config, sort_keys=False, allow_unicode=True)


def _meanings(results: Results) -> Iterator[Plain]:
    rows = [
        {"approach": label(name), "meaning": MEANINGS[name]}
        for name in results.approaches
        if name in MEANINGS
    ]
    if rows:
        yield Plain("What the rows mean", rows)


def _distributions(results: Results) -> Iterator[Drawing]:
    for measure, what in (("iou", "IoU"), ("correct_pixels", "Correctly predicted pixels")):
        for category in results.categories:
            yield Drawing(
                f"distribution_{measure}_{category}",
                f"{what} of each run by approach and cell width, {category}.",
                partial(draw_distribution, results.counts, category, measure),
            )


def _maps(results: Results) -> Iterator[Drawing]:
    """Drawn from saved maps; from none where none are."""
    if not results.maps:
        if results.counts:
            results.problems.append("maps/ is missing: maps, viewpoints, precision and recall are not drawn")
        return
    results.problems += missing_maps(results.counts, results.maps)
    for category in results.categories:
        widths = [width for width in results.cell_widths if maps.typical(results.maps, category, width)]
        ranking = label(ranked_by(results.approaches))
        for width in widths[-1:]:
            yield Drawing(
                f"maps_{category}",
                f"Maps of {category} at a cell width of {width:g} m: the run whose IoU by {ranking} is the median.",
                partial(maps.draw_typical, results.maps, category, [width]),
                wide=True,
            )
    yield Drawing(
        "viewpoints",
        "Sparse viewpoints (Algorithm 1) and the headings taken there, on the map of the scene with most of them.",
        partial(maps.draw_viewpoints, results.maps),
        wide=True,
    )


def _ranking(results: Results) -> str:
    views, _ = results.singles
    if not views:
        return ""
    return (
        f"The best, the median and the worst view of the test scenes by IoU of "
        f"{label(ranked_by(list(views[0].predicted)))} with V_label, among views with at least "
        f"{MIN_LABEL:g} m² of label; of equals that with the most. Each approach draws from this view alone, with the "
        "threshold of its global map. The triangle is the robot, looking up."
    )


def _singles(results: Results) -> Iterator[Drawing]:
    views, resolution = results.singles
    if not views and results.counts:
        results.problems.append(f"{FILE} is missing or holds none: single predictions are not drawn")
    for category in dict.fromkeys(view.category for view in views):
        of = [view for view in views if view.category == category]
        yield Drawing(
            f"single_{category}",
            f"Single predictions of {category}.",
            partial(draw_singles, of, resolution),
            wide=True,
        )


def _scores(results: Results) -> Iterator[Drawing]:
    chosen: dict[tuple[str, str], float] = {}
    if results.maps:
        first = results.maps[0]
        chosen = {
            (name, category): first.threshold[place, layer].item() / 100
            for place, name in enumerate(first.approaches)
            for layer, category in enumerate(first.categories)
        }
    pooled, views = maps.tallies(results.maps), results.view_tallies
    of_views = {
        (name, of): confusion_counts for (name, part, of), confusion_counts in views.items() if part == "all"
    }
    by_approach = {key: confusion_counts for key, confusion_counts in of_views.items() if key[0] != "network"}
    network = {
        (part, of): confusion_counts
        for (name, part, of), confusion_counts in views.items()
        if name == "network"
    }
    for stem, what, tallies in (("maps", "global maps", pooled), ("views", "single views", by_approach)):
        for category, lines in _by_category(tallies).items():
            thresholds = {name: value for (name, of), value in chosen.items() if of == category}
            yield Drawing(
                f"precision_recall_{stem}_{category}",
                f"Precision over recall of {what}, {category}: all runs together, at every threshold.",
                partial(draw_precision_recall, lines, thresholds, f"{category}, {what}"),
            )
    for category, lines in _by_category(pooled).items():
        yield Drawing(
            f"reliability_maps_{category}",
            f"Scores of global maps before the threshold, and how often they are right, {category}.",
            partial(draw_reliability, lines, f"{category}, global maps"),
        )
    for category, lines in _by_category(network).items():
        ordered = {part: lines[part] for part in CELLS if part in lines}
        yield Drawing(
            f"reliability_network_{category}",
            f"The network's probabilities in single views, and how often they are right, {category}.",
            partial(draw_reliability, ordered, f"{category}, the network in single views"),
        )


def _by_category(tallies: Mapping[tuple[str, str], ConfusionCounts]) -> dict[str, dict[str, ConfusionCounts]]:
    found: dict[str, dict[str, ConfusionCounts]] = {}
    for (name, category), confusion_counts in tallies.items():
        found.setdefault(category, {})[name] = confusion_counts
    return found


def _charts(results: Results) -> list[training_curves.Chart]:
    """The curves of a run; of an evaluation, those of its networks side by side."""
    logged = [(run, run.folder / training_curves.FOLDER) for run in results.trained]
    logged = [(run, folder) for run, folder in logged if folder.is_dir()]
    if results.trained != [results]:
        curves = [(run.name, run.predicts, training_curves.read(folder)) for run, folder in logged]
        return training_curves.compared(curves)
    found = [chart for _, folder in logged for chart in training_curves.charts(training_curves.read(folder))]
    if logged and not found:
        results.problems.append(
            f"{training_curves.FOLDER}/ holds no curves: its event files are missing or damaged"
        )
    return found


def _training(results: Results) -> Iterator[Drawing]:
    for chart in _charts(results):
        yield Drawing(
            chart.stem,
            f"{chart.title} over updates of the weights.",
            partial(draw_curves, chart.curves, chart.title, "update", chart.up),
        )


def _further(results: Results) -> Iterator[Plain]:
    for path in sorted((results.folder / "tables").glob("*.csv")):
        made = path.name.startswith(("iou", "correct_pixels.", "paired_"))  # by an earlier report
        if path.name not in TOLD and not made:
            rows = results.table(path.name)
            if 0 < len(rows) <= MAX_ROWS:
                yield Plain(TITLES.get(path.name, path.name), rows)
