"""Evaluation at desk scale: views from sparse viewpoints to scores, beside rendering and predicting them alone."""

from __future__ import annotations

import shutil
from dataclasses import replace

from hydra.utils import instantiate

from benchmarks.measure import Figure, medians
from benchmarks.subjects import config
from imagination.evaluation.protocol import MappingProtocol
from imagination.evaluation.results import subject_of
from imagination.evaluation.runs import Looks, render, runs_of, views_of

HOMES = [f"test_{number:04d}" for number in range(6)]


def run(folder: str) -> list[Figure]:
    """All figures."""
    desk = config(folder, "scale.workers=0")
    data = instantiate(desk.data.module)
    model = instantiate(desk.model.module).eval()
    asked: MappingProtocol = replace(instantiate(desk.evaluation), viewpoint_sets=1)
    subject, observer = subject_of(data, [model], asked.precision, keep=False), data.observer
    protocol = asked.available(subject.predict.gives)
    needs = protocol._plan(subject).needs
    for home in HOMES:
        observer.truth(home)  # measured elsewhere
    runs, looks = runs_of(HOMES, protocol.cell_widths, 1), Looks(protocol.seed, protocol.orientations)

    def rendered() -> None:
        shutil.rmtree(kept, ignore_errors=True)
        render(subject.pool, runs, looks, silent=True)

    def predicted() -> None:
        for each in views:
            subject.predict(each, needs)

    kept = f"{folder}/evaluation_views"
    rendered()
    # a home may have no viewpoint at a wide spacing
    views = [each for run in runs if len((each := views_of(observer, run, looks))["pose"])]
    choices = protocol.choose(subject, HOMES, silent=True)
    seconds = medians(
        {
            "render": rendered,
            "predict": predicted,
            "choose": lambda: protocol.choose(subject, HOMES, silent=True),
            "measure": lambda: protocol.measure(subject, HOMES, choices, silent=True),
        },
        least=3,
    )
    count = sum(len(each["pose"]) for each in views) // protocol.orientations
    rendering, predicting = seconds["render"], seconds["predict"]
    limit = count / (rendering + predicting), "rendering and predicting them alone"
    looks_each, approaches = protocol.orientations, len(protocol.approaches)
    note = f"{count} viewpoints of {looks_each} views, {approaches} approaches, one process"
    return [
        Figure(
            "evaluation: viewpoints rendered, mapped and scored",
            count / (rendering + seconds["measure"]),
            "viewpoints/s",
            *limit,
            note=note,
        ),
        Figure(
            "evaluation: choosing thresholds and kernels on validation homes",
            count / seconds["choose"],
            "viewpoints/s",
            count / predicting,
            "predicting them alone",
            note=note,
        ),
    ]
