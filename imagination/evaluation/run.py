"""Evaluation of trained networks: thresholds on validation scenes, global maps and single views of test scenes."""

import logging
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from imagination.data.datamodule import SceneData
from imagination.evaluation import record_files, saved_maps, single_views
from imagination.evaluation.approaches import NEEDS, Setting
from imagination.evaluation.prediction import Network, Predictor
from imagination.evaluation.protocol import MappingProtocol, ModelUnderTest
from imagination.evaluation.record_files import Evaluation
from imagination.evaluation.records import Report, SelectedThresholds
from imagination.scenes.source import Credited, SpareScenes
from imagination.utils.provenance import current_provenance
from imagination.utils.tabular import Row

log = logging.getLogger(__name__)


def model_under_test(
    data: SceneData, models: Sequence[Network], precision: str, keep: bool = True
) -> ModelUnderTest:
    """Combine trained networks, which predict in `precision`, with the scenes and worker processes of their data."""
    observer = data.observer
    setting = Setting(
        observer.camera, observer.ego, data.layers, data.unit_categories, len(observer.categories)
    )
    names = data.unit_categories, observer.categories.names
    predictor = Predictor(models, *names, data.batch_size, precision)
    if keep:
        _ = predictor.fingerprint  # read now: its files may be edited while scenes are rendered
    return ModelUnderTest(data.pool, setting, predictor, keep)


def evaluate(
    protocol: MappingProtocol,
    data: SceneData,
    models: Sequence[Network],
    folder: Path,
    networks: Sequence[Row] = (),
) -> Evaluation:
    """Select thresholds on validation scenes, evaluate on test scenes and write the records.

    The records are records/, maps/ and single_views.npz. Tables and figures are made from them.

    Args:
        protocol: protocol of the evaluation; approaches whose network is missing are left out.
        data: scenes and views.
        models: trained networks.
        folder: folder of the results.
        networks: rows on the training of the networks.

    Raises:
        UserError: if a split does not contain a category, an approach in `only` lacks its network, or the disk is full.
    """
    start = perf_counter()
    model = model_under_test(data, models, protocol.precision)
    requested, protocol = protocol, protocol.available(model.predict.gives)
    _log_left_out(requested, protocol)
    for split in ("val", "test"):
        data.survey(split)
    source = data.observer.source
    selected = protocol.select_thresholds(model, source.scenes("val"))
    scenes = source.scenes("test")
    record_files.write_scenes(folder, scenes)
    report = protocol.evaluate(model, scenes, selected, save=lambda maps: saved_maps.save(folder, maps))
    known = _evaluate_known(protocol, model, selected)
    single_views.write(
        folder, single_views.evaluate_single_views(protocol, model, scenes, selected, data.imaginable)
    )
    credits = source.credits() if isinstance(source, Credited) else ()
    evaluation = Evaluation(
        protocol, model.setting, report, known, networks, credits, data.seed, perf_counter() - start,
        current_provenance(),
    )  # fmt: skip
    record_files.write(folder, evaluation)
    return evaluation


def _log_left_out(requested: MappingProtocol, available: MappingProtocol) -> None:
    """Log the approaches whose network is missing, unless `only` selects the approaches."""
    if requested.only is not None:
        return
    if left_out := [name for name in requested.approaches if name not in available.approaches]:
        needed = {NEEDS[requested.approaches[name].evidence.needs or ""] for name in left_out}
        log.info("Approaches left out: %s, which need %s", ", ".join(left_out), "; ".join(sorted(needed)))


def _evaluate_known(
    protocol: MappingProtocol, model: ModelUnderTest, selected: SelectedThresholds
) -> Report | None:
    """Evaluate in scenes with training furniture that were not trained on; None if the protocol requests none."""
    if not protocol.known_scenes:
        return None
    source = model.pool.observer.source
    if not isinstance(source, SpareScenes):
        log.warning(
            "evaluation.known_scenes: the scene source %s has no spare scenes with training furniture; known and "
            "unseen furniture are not compared",
            source.name,
        )
        return None
    scenes = source.spare(protocol.known_scenes)
    return protocol.evaluate(model, scenes, selected, title="global maps of scenes with known furniture")
