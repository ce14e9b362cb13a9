"""Writer of an evaluation's records, from which every table and figure is made.

    records/trials.csv       counts of every trial: one row per approach, category, cell width, scene and viewpoint set
    records/evaluation.json  settings, selected thresholds, networks, credits and provenance
    records/scenes.csv       names of the scenes to evaluate, written when the evaluation starts
    records/thresholds.csv   counts of single views at every threshold; see `single_views`

`split` in trials.csv is `test`, or `known` for scenes with training furniture. The three counts (correct,
false-positive and ground-truth pixels) are over the whole map; with the suffix `_seen`, over the cells that at least
one view saw; with `_shuffled`, over the whole map with the views registered in a random order.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from math import degrees, isinf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from imagination.evaluation.approaches import Approach, ProjectedSegmentation, Setting
from imagination.evaluation.protocol import MappingProtocol
from imagination.evaluation.records import Report
from imagination.scenes.source import Credit
from imagination.utils.atomic_io import write_text
from imagination.utils.precision import resolved
from imagination.utils.provenance import Provenance
from imagination.utils.tabular import Row, csv_text, to_csv

FOLDER = "records"
"""Folder of the records in the folder of the results."""

TRIALS, ABOUT, SCENES = "trials.csv", "evaluation.json", "scenes.csv"
"""Files in the folder of the records."""

VERSION = 1
"""Version of the format of the records."""

PIXELS = "correct_pixels", "false_positives", "gt_pixels"
"""Columns of the three counts."""

TRIAL_KEY = "approach", "category", "cell_width", "scene", "viewpoint_set"
"""Columns that identify a trial of one training seed and split."""

ROW_KEY = "split", *TRIAL_KEY
"""Columns that identify a row of trials.csv."""

SUFFIXES = {"": "counts", "_seen": "seen", "_shuffled": "shuffled"}
"""Fields of `Report` by the suffix of the columns that hold their counts."""

COLUMNS = [*ROW_KEY, *(f"{name}{suffix}" for suffix in SUFFIXES for name in PIXELS)]
"""Columns of trials.csv."""

MAX_PIXELS = 10**12
"""Maximum pixel count of a trial, so that sums of counts stay exact."""


class Evaluation(NamedTuple):
    """Records of an evaluation, from which tables and figures are made.

    Attributes:
        protocol: protocol with the approaches that were evaluated.
        setting: camera, grid and categories.
        report: results on the test scenes.
        known: results on scenes with training furniture; None if the protocol requests none.
        networks: rows on the training of the networks; see `networks.network_rows`.
        credits: credits of the models and scans in the scenes.
        seed: seed of the training run.
        seconds: wall time, seconds.
        provenance: date, version, git commit, command and processor.
    """

    protocol: MappingProtocol
    setting: Setting
    report: Report
    known: Report | None
    networks: Sequence[Row]
    credits: Sequence[Credit]
    seed: int
    seconds: float
    provenance: Provenance


def write_scenes(folder: Path, scenes: Sequence[str]) -> None:
    """Write the names of the scenes to evaluate; they show which are missing after an interrupted evaluation."""
    write_text(folder / FOLDER / SCENES, to_csv([{"scene": scene} for scene in scenes]))


def write(folder: Path, evaluation: Evaluation) -> None:
    """Write trials.csv and evaluation.json into the folder of the results, each atomically.

    Raises:
        UserError: if the disk is full or the folder cannot be written.
    """
    rows = [*_rows("test", evaluation.report)]
    if evaluation.known is not None:
        rows += _rows("known", evaluation.known)
    write_text(folder / FOLDER / TRIALS, csv_text([COLUMNS, *rows]))
    about = {**_about(evaluation), "folder": str(folder.resolve())}
    write_text(folder / FOLDER / ABOUT, json.dumps(about, indent=1, allow_nan=False) + "\n")


def _rows(split: str, report: Report) -> Iterator[list[Any]]:
    """Yield the rows of trials.csv of one set of scenes."""
    for key, counts in report.counts.items():
        others = [getattr(report, field)[key] for field in SUFFIXES.values()]
        for place, scene in enumerate(report.scenes[key.category]):
            for number in range(counts.shape[1]):
                pixels = [value for each in others for value in each[place, number].tolist()]
                yield [split, key.approach, key.category, f"{key.cell_width:.17g}", scene, number, *pixels]


def _about(evaluation: Evaluation) -> dict[str, Any]:
    """Return the content of evaluation.json."""
    protocol, setting, report = evaluation.protocol, evaluation.setting, evaluation.report
    distances = np.concatenate(report.snap_distances)
    return {
        "version": VERSION,
        "seed": evaluation.seed,
        "resolution": setting.ego.resolution,
        "sensor": described_sensor(setting, protocol.approaches),
        "precision": resolved(protocol.precision),
        "protocol": {
            "cell_widths": list(map(float, protocol.cell_widths)),
            "viewpoint_sets": protocol.viewpoint_sets,
            "orientations": protocol.orientations,
            "seed": protocol.seed,
            "resamples": protocol.resamples,
        },
        "approaches": {
            name: {"rule": str(approach.rule), "postprocess": approach.postprocess}
            for name, approach in protocol.approaches.items()
        },
        "selected": [
            {"approach": approach, "category": category, **selected._asdict()}
            for (approach, category), selected in report.selected.items()
        ],
        "scenes": {category: len(names) for category, names in report.scenes.items()},
        "left_out": {category: len(names) for category, names in report.left_out.items()},
        "viewpoints": {
            "sets": len(report.snap_distances),
            "empty": sum(len(each) == 0 for each in report.snap_distances),
            "viewpoints": len(distances),
            "moved": float(distances.mean()) if len(distances) else 0.0,
        },
        "first_person": report.first_person,
        "networks": list(evaluation.networks),
        "credits": [credit._asdict() for credit in evaluation.credits],
        "seconds": evaluation.seconds,
        "provenance": evaluation.provenance._asdict(),
    }


def described_sensor(setting: Setting, approaches: Mapping[str, Approach]) -> str:
    """Describe the sensor and egocentric map of all approaches, and the limits of those that project segmentation."""
    camera, ego = setting.camera, setting.ego
    description = (
        f"{camera.width} x {camera.height} pixels, field of view {degrees(camera.field_of_view):.0f} degrees, "
        f"{camera.mount_height:g} m above the floor; egocentric map of {ego.cells * ego.resolution:.2f} m a side, "
        f"cells of {ego.resolution:g} m"
    )
    for name, approach in approaches.items():
        if isinstance(evidence := approach.evidence, ProjectedSegmentation):
            limit = "the egocentric map" if isinf(evidence.max_range) else f"{evidence.max_range:g} m"
            band = f"{evidence.low:g} to {evidence.high:g} m above the floor"
            description += f"; {name} projects returns {band}, range limit {limit}"
    return description
