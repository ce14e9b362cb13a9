"""Evaluation at desk scale: views from sparse viewpoints to scores, beside rendering and predicting them alone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from hydra.utils import instantiate

from imagination.evaluation.protocol import MappingProtocol, Subject
from imagination.evaluation.run import subject_of
from imagination.evaluation.trials import KIND, Looks, render, runs_of, views_of
from tests.benchmarks.measure import Figure, medians
from tests.benchmarks.subjects import config

HOMES = [f"test_{number:04d}" for number in range(6)]


def run(folder: str) -> list[Figure]:
    """All figures."""
    subject, protocol = set_up(folder)
    count, seconds = timed(subject, protocol)
    rendering, predicting = seconds["render"], seconds["predict"]
    views, approaches = protocol.orientations, len(protocol.approaches)
    note = f"{count} viewpoints of {views} views, {approaches} approaches, one process"
    return [
        Figure(
            "evaluation: viewpoints rendered, mapped and scored",
            count / (rendering + seconds["measure"]),
            "viewpoints/s",
            count / (rendering + predicting),
            "rendering and predicting them alone",
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


def set_up(folder: str) -> tuple[Subject, MappingProtocol]:
    """The default unit, untrained, and how it is evaluated: one set of viewpoints, nothing kept."""
    desk = config(folder, "scale.workers=0")
    data = instantiate(desk.data.module)
    model = instantiate(desk.model.module).eval()
    asked: MappingProtocol = replace(instantiate(desk.evaluation), viewpoint_sets=1)
    subject = subject_of(data, [model], asked.precision, keep=False)
    for home in HOMES:
        data.observer.truth(home)  # measured elsewhere
    return subject, asked.available(subject.predict.gives)


def timed(subject: Subject, protocol: MappingProtocol) -> tuple[int, dict[str, float]]:
    """How many viewpoints there are, and the seconds that each part takes for all of them."""
    observer = subject.pool.observer
    runs = runs_of(HOMES, protocol.cell_widths, 1)
    looks, needs = Looks(protocol.seed, protocol.orientations), protocol._plan(subject).needs

    def render_anew() -> None:
        shutil.rmtree(Path(observer.cache.folder, KIND), ignore_errors=True)
        render(subject.pool, runs, looks, silent=True)

    def predict() -> None:
        for each in views:
            subject.predict(each, needs)

    render_anew()
    # a home may have no viewpoint at a wide spacing
    views = [each for run in runs if len((each := views_of(observer, run, looks))["pose"])]
    choices = protocol.choose(subject, HOMES, silent=True)
    seconds = medians(
        {
            "render": render_anew,
            "predict": predict,
            "choose": lambda: protocol.choose(subject, HOMES, silent=True),
            "measure": lambda: protocol.measure(subject, HOMES, choices, silent=True),
        },
        least=3,
    )
    return sum(len(each["pose"]) for each in views) // protocol.orientations, seconds
