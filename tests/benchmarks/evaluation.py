"""Evaluation at small scale, from views of sparse viewpoints to scores, and its rendering and prediction alone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from hydra.utils import instantiate

from imagination.evaluation.protocol import MappingProtocol, ModelUnderTest
from imagination.evaluation.run import model_under_test
from imagination.evaluation.trials import KIND, ViewpointSampling, render, trials_of, views_of
from tests.benchmarks.measure import Figure, medians
from tests.benchmarks.subjects import config

SCENES = [f"test_{number:04d}" for number in range(6)]


def run(folder: str) -> list[Figure]:
    """Return all figures."""
    model, protocol = set_up(folder)
    count, seconds = timed(model, protocol)
    rendering, predicting = seconds["render"], seconds["predict"]
    views, approaches = protocol.orientations, len(protocol.approaches)
    note = f"{count} viewpoints of {views} views, {approaches} approaches, one process"
    return [
        Figure(
            "evaluation: viewpoints rendered, mapped and scored",
            count / (rendering + seconds["evaluate"]),
            "viewpoints/s",
            count / (rendering + predicting),
            "rendering and predicting them alone",
            note=note,
        ),
        Figure(
            "evaluation: selection of thresholds and kernels on validation scenes",
            count / seconds["select"],
            "viewpoints/s",
            count / predicting,
            "predicting them alone",
            note=note,
        ),
    ]


def set_up(folder: str) -> tuple[ModelUnderTest, MappingProtocol]:
    """Return the untrained default unit and a protocol with one set of viewpoints."""
    run_config = config(folder, "data.workers=0")
    data = instantiate(run_config.data.module)
    module = instantiate(run_config.model.module).eval()
    protocol: MappingProtocol = replace(instantiate(run_config.evaluation), viewpoint_sets=1)
    model = model_under_test(data, [module], protocol.precision, keep=False)
    for scene in SCENES:
        data.observer.ground_truth(scene)  # measured in another section
    return model, protocol.available(model.predict.gives)


def timed(model: ModelUnderTest, protocol: MappingProtocol) -> tuple[int, dict[str, float]]:
    """Return the number of viewpoints, and the time of each part for all of them, seconds."""
    observer = model.pool.observer
    trials = trials_of(SCENES, protocol.cell_widths, 1)
    sampling, needs = ViewpointSampling(protocol.seed, protocol.orientations), protocol._plan(model).needs

    def render_all() -> None:
        shutil.rmtree(Path(observer.cache.folder, KIND), ignore_errors=True)
        render(model.pool, trials, sampling, silent=True)

    def predict() -> None:
        for batch in views:
            model.predict(batch, needs)

    render_all()
    # a scene may have no viewpoint at a wide spacing
    views = [batch for trial in trials if len((batch := views_of(observer, trial, sampling))["pose"])]
    thresholds = protocol.select_thresholds(model, SCENES, silent=True)
    seconds = medians(
        {
            "render": render_all,
            "predict": predict,
            "select": lambda: protocol.select_thresholds(model, SCENES, silent=True),
            "evaluate": lambda: protocol.evaluate(model, SCENES, thresholds, silent=True),
        },
        min_calls=3,
    )
    return sum(len(batch["pose"]) for batch in views) // protocol.orientations, seconds
