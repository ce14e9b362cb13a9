"""Evaluation at small scale: views from sparse viewpoints to scores, beside rendering and predicting them alone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from hydra.utils import instantiate
from tests.benchmarks.evaluate import Figure, medians

from imagination.evaluation.protocol import MappingProtocol, ModelUnderTest
from imagination.evaluation.run import model_under_test
from imagination.evaluation.trials import KIND, ViewpointSampling, render, trials_of, views_of
from tests.benchmarks.subjects import config

SCENES = [f"test_{number:04d}" for number in range(6)]


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
            "evaluation: choosing thresholds and kernels on validation scenes",
            count / seconds["choose"],
            "viewpoints/s",
            count / predicting,
            "predicting them alone",
            note=note,
        ),
    ]


def set_up(folder: str) -> tuple[ModelUnderTest, MappingProtocol]:
    """The default unit, untrained, and how it is evaluated: one set of viewpoints, nothing kept."""
    desk = config(folder, "scale.workers=0")
    data = instantiate(desk.data.module)
    model = instantiate(desk.model.module).eval()
    asked: MappingProtocol = replace(instantiate(desk.evaluation), viewpoint_sets=1)
    subject = model_under_test(data, [model], asked.precision, keep=False)
    for scene in SCENES:
        data.observer.ground_truth(scene)  # measured elsewhere
    return subject, asked.available(subject.predict.gives)


def timed(subject: ModelUnderTest, protocol: MappingProtocol) -> tuple[int, dict[str, float]]:
    """How many viewpoints there are, and the seconds that each part takes for all of them."""
    observer = subject.pool.observer
    runs = trials_of(SCENES, protocol.cell_widths, 1)
    sampling, needs = ViewpointSampling(protocol.seed, protocol.orientations), protocol._plan(subject).needs

    def render_anew() -> None:
        shutil.rmtree(Path(observer.cache.folder, KIND), ignore_errors=True)
        render(subject.pool, runs, sampling, silent=True)

    def predict() -> None:
        for each in views:
            subject.predict(each, needs)

    render_anew()
    # a scene may have no viewpoint at a wide spacing
    views = [each for run in runs if len((each := views_of(observer, run, sampling))["pose"])]
    choices = protocol.select_thresholds(subject, SCENES, silent=True)
    seconds = medians(
        {
            "render": render_anew,
            "predict": predict,
            "choose": lambda: protocol.select_thresholds(subject, SCENES, silent=True),
            "measure": lambda: protocol.evaluate(subject, SCENES, choices, silent=True),
        },
        least=3,
    )
    return sum(len(each["pose"]) for each in views) // protocol.orientations, seconds
