"""Evaluate trained networks: thresholds on validation scenes, global maps and single views of test scenes."""

import logging
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from imagination.data.datamodule import SceneData
from imagination.evaluation import saved_maps, single_views
from imagination.evaluation.approaches import NEEDS, Setting
from imagination.evaluation.prediction import Model, Predictor, Segmenter
from imagination.evaluation.protocol import MappingProtocol, ModelUnderTest
from imagination.evaluation.records import Report, SelectedThresholds, write_scenes
from imagination.scenes.source import Credit, Credited, SpareScenes

log = logging.getLogger(__name__)


class Evaluation(NamedTuple):
    """Records of an evaluation, from which tables and figures are made.

    Attributes:
        protocol: with the approaches that were evaluated.
        setting: camera, grid and categories.
        report: of the test scenes.
        known: of scenes with furniture as in training; None if none were asked for.
        credits: whose models and scans the scenes hold.
        seed: of the run that trained.
        seconds: of wall time.
    """

    protocol: MappingProtocol
    setting: Setting
    report: Report
    known: Report | None
    credits: Sequence[Credit]
    seed: int
    seconds: float


def model_under_test(
    data: SceneData, models: Sequence[Model | Segmenter], precision: str, keep: bool = True
) -> ModelUnderTest:
    """Trained networks, answering in `precision`, in the scenes of their data; units together imagine its categories."""
    observer = data.observer
    setting = Setting(
        observer.camera, observer.ego, data.layers, data.unit_categories, len(observer.categories)
    )
    names = data.unit_categories, observer.categories.names
    predictor = Predictor(models, *names, data.batch_size, precision)
    return ModelUnderTest(data.pool, setting, predictor, keep)


def evaluate(
    protocol: MappingProtocol, data: SceneData, models: Sequence[Model | Segmenter], folder: Path
) -> Evaluation:
    """Select thresholds on validation scenes, evaluate on test scenes and write the records: maps and single views.

    Args:
        protocol: of the evaluation; approaches that need other networks are left out.
        data: scenes and views.
        models: trained networks.
        folder: tables/, maps/ and single_views.npz are written into it.

    Raises:
        UserError: if a split contains none of a category, an approach that was asked for lacks its network, or the
            disk is full.
    """
    start = perf_counter()
    subject = model_under_test(data, models, protocol.precision)
    asked, protocol = protocol, protocol.available(subject.predict.gives)
    _log_left_out(asked, protocol)
    for split in ("val", "test"):
        data.survey(split)
    source = data.observer.source
    choices = protocol.select_thresholds(subject, source.scenes("val"))
    scenes = source.scenes("test")
    write_scenes(folder / "tables", scenes)
    found = protocol.evaluate(subject, scenes, choices, save=lambda maps: saved_maps.save(folder, maps))
    known = _known(protocol, subject, choices)
    single_views.write(
        folder, single_views.evaluate_single_views(protocol, subject, scenes, choices, data.imaginable)
    )
    credits = source.credits() if isinstance(source, Credited) else ()
    return Evaluation(protocol, subject.setting, found, known, credits, data.seed, perf_counter() - start)


def _log_left_out(asked: MappingProtocol, available: MappingProtocol) -> None:
    """Log the approaches that lack a network, unless approaches were named."""
    left_out = [name for name in asked.approaches if name not in available.approaches and asked.only is None]
    if left_out:
        needed = {NEEDS[asked.approaches[name].evidence.needs or ""] for name in left_out}
        log.info("Left out: %s, which would need %s", ", ".join(left_out), "; ".join(sorted(needed)))


def _known(protocol: MappingProtocol, subject: ModelUnderTest, choices: SelectedThresholds) -> Report | None:
    """The same in scenes with furniture as in training, none of which is trained on; None if none is asked for."""
    if not protocol.known_scenes:
        return None
    source = subject.pool.observer.source
    if not isinstance(source, SpareScenes):
        log.warning(
            "evaluation.known_scenes: the scene source %s has no scenes like those of training beside them, so known "
            "furniture is not compared with unseen",
            source.name,
        )
        return None
    scenes = source.spare(protocol.known_scenes)
    return protocol.evaluate(subject, scenes, choices, title="global maps of scenes with known furniture")
