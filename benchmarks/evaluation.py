"""Evaluation at desk scale: views from sparse viewpoints to scores, beside rendering and predicting them alone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from time import perf_counter

from hydra.utils import instantiate

from benchmarks.measure import Figure
from benchmarks.subjects import config
from imagination.evaluation.protocol import MappingProtocol
from imagination.evaluation.results import subject_of
from imagination.evaluation.runs import Looks, render, runs_of, views_of

HOMES = ["test_0000", "test_0001"]


def run(folder: str) -> list[Figure]:
    """All figures."""
    desk = config(folder, "scale.workers=0")
    data = instantiate(desk.data.module)
    model = instantiate(desk.model.module).eval()
    asked: MappingProtocol = replace(instantiate(desk.evaluation), viewpoint_sets=1)
    subject, observer = subject_of(data, [model], asked.precision), data.observer
    protocol = asked.available(subject.predict.gives)
    needs = protocol._plan(subject).needs
    for home in HOMES:
        observer.truth(home)  # measured elsewhere
    runs, looks = runs_of(HOMES, protocol.cell_widths, 1), Looks(protocol.seed, protocol.orientations)
    start = perf_counter()
    render(subject.pool, runs, looks, silent=True)
    rendering = perf_counter() - start
    # a home may have no viewpoint at a wide spacing
    views = [each for run in runs if len((each := views_of(observer, run, looks))["pose"])]
    count = sum(len(each["pose"]) for each in views)
    subject.predict(views[0], needs)
    start = perf_counter()
    for each in views:
        subject.predict(each, needs)
    predicting = perf_counter() - start
    start = perf_counter()
    choices = protocol.choose(subject, HOMES, silent=True)
    choosing = perf_counter() - start
    start = perf_counter()
    protocol.measure(subject, HOMES, choices, silent=True)
    measuring = perf_counter() - start
    shutil.rmtree(f"{folder}/evaluation_views", ignore_errors=True)
    count //= protocol.orientations
    limit = count / (rendering + predicting), "rendering and predicting them alone"
    looks_each, approaches = protocol.orientations, len(protocol.approaches)
    note = f"{count} viewpoints of {looks_each} views, once, {approaches} approaches, one process"
    return [
        Figure(
            "evaluation: viewpoints rendered, mapped and scored",
            count / (rendering + measuring),
            "viewpoints/s",
            *limit,
            note=note,
        ),
        Figure(
            "evaluation: choosing thresholds and kernels on validation homes",
            count / choosing,
            "viewpoints/s",
            count / predicting,
            "predicting them alone",
            note=note,
        ),
    ]
