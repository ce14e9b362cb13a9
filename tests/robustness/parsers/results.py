"""Parsers of results: folders of runs and sweeps, read and drawn by a report."""

import json
from collections.abc import Callable
from pathlib import Path

from imagination.report import read
from imagination.reporting import html
from imagination.reporting.content import Drawing
from imagination.reporting.paper_layout import to_csv, to_latex, to_markdown
from imagination.reporting.style import THEMES
from imagination.runs import sweep_jobs
from imagination.runs.sweep_jobs import FILE
from tests.helpers.run_folders import make_folder
from tests.reporting.test_load_run import log
from tests.robustness.parsers.parser import Parser, resealed, temporary_folder, with_file_replaced

MAPS, SINGLES = "maps/test_0000_3m_0.npz", "single_views.npz"
EVENTS = "tensorboard/events.out.tfevents.1.host.1.0"


def write(folder: Path) -> None:
    """Write the folder of an evaluation with all files that a report reads."""
    make_folder(folder)
    (folder / "tables" / "ego.csv").write_text("category,score\nchair,0.5\n")
    log(
        folder / "tensorboard",
        train__loss=[3.0, 2.0],
        val__iou=[0.25, 0.5],
        global__chair__imagination__val=[0.5],
    )
    next((folder / "tensorboard").iterdir()).rename(folder / EVENTS)


def write_sweep(folder: Path) -> None:
    """Write a sweep of two jobs."""
    for number in range(2):
        make_folder(folder / str(number), choices=[f"seed={number}"], seed=number)
    rows = [f"{number},key{number},done,0.5,seed={number},\n" for number in range(2)]
    (folder / FILE).write_text("".join(["folder,key,state,score,overrides,problem\n", *rows]))
    hydra = {"overrides": {"task": ["+experiment=made", "seed=0,1"]}, "job": {"name": "train"}}
    sweeper = {"_target_": "hydra._internal.BasicSweeper", "params": None}
    (folder / "multirun.yaml").write_text(json.dumps({"hydra": {**hydra, "sweeper": sweeper}}))


def report(*figures: str) -> Callable[[Path], object]:
    """Return a function that renders the page and tables and, if no file is refused, some figures as thumbnails."""

    def picture(drawing: Drawing) -> str:
        return str(len(html.png(drawing, "light", 15)[1])) if drawing.stem.startswith(figures) else ""

    def render(folder: Path) -> object:
        content = read(folder)
        for table in (table for section in content.sections for table in section.layouts):
            to_csv(table), to_markdown(table), to_latex(table)
        draw = (lambda _: "") if content.problems else picture
        template = html.environment().get_template("page.html.j2")
        return template.render(content=content, picture=draw, colours=THEMES, names=html.file_names(content))

    return render


RESULTS, SWEEP = temporary_folder(write), temporary_folder(write_sweep)

RECORDS = {
    "records/trials.csv": report("distribution", "maps"),
    "records/thresholds.csv": report("precision_recall_views", "reliability_network"),
    **dict.fromkeys(("records/evaluation.json", "tables/ego.csv"), report()),
}
maps = report("maps", "viewpoints", "precision_recall_maps", "reliability_maps")
single_views, sweep = report("single"), report("ablation")

PARSERS = [
    Parser("results-config.yaml", *with_file_replaced(RESULTS, "config.yaml", report())),
    *(
        Parser(f"results-{Path(name).name}", *with_file_replaced(RESULTS, name, read))
        for name, read in RECORDS.items()
    ),
    Parser("results-maps", *with_file_replaced(RESULTS, MAPS, maps)),
    Parser("results-maps-resealed", *resealed(*with_file_replaced(RESULTS, MAPS, maps))),
    Parser("results-single-views", *with_file_replaced(RESULTS, SINGLES, single_views)),
    Parser("results-single-views-resealed", *resealed(*with_file_replaced(RESULTS, SINGLES, single_views))),
    Parser("results-curves", *with_file_replaced(RESULTS, EVENTS, report("curve"))),
    Parser("sweep-config.yaml", *with_file_replaced(SWEEP, "1/config.yaml", sweep)),
    Parser("sweep-jobs.csv", *with_file_replaced(SWEEP, FILE, sweep)),
    Parser("sweep-resumed", *with_file_replaced(SWEEP, FILE, sweep_jobs.read)),
    Parser("sweep-multirun.yaml", *with_file_replaced(SWEEP, "multirun.yaml", sweep)),
]
