"""Files of an evaluation's records, from which every table and figure is made.

    records/trials.csv       counts of every trial: one row per approach, category, cell width, scene and viewpoint set
    records/evaluation.json  settings, selected thresholds, networks, credits and provenance
    records/scenes.csv       names of the scenes to evaluate, written when the evaluation starts
    records/thresholds.csv   counts of single views at every threshold; see `single_views`

`split` in trials.csv is `test`, or `known` for scenes with training furniture. The three counts (correct,
false-positive and ground-truth pixels) are over the whole map; with the suffix `_seen`, over the cells that at least
one view saw; with `_shuffled`, over the whole map with the views registered in a random order.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import degrees, isinf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from imagination.evaluation.approaches import Approach, ProjectedSegmentation, Setting
from imagination.evaluation.protocol import MappingProtocol
from imagination.evaluation.records import Report
from imagination.scenes.source import Credit
from imagination.utils.atomic_io import write_text
from imagination.utils.errors import UserError, check_range
from imagination.utils.precision import resolved
from imagination.utils.provenance import Provenance
from imagination.utils.tabular import MAX_BYTES, Row, csv_text, read_csv, to_csv

FOLDER = "records"
"""Folder of the records in the folder of the results."""

TRIALS, ABOUT, SCENES = "trials.csv", "evaluation.json", "scenes.csv"
"""Files in the folder of the records."""

VERSION = 1
"""Version of the format of the records."""

PIXELS = "correct_pixels", "false_positives", "gt_pixels"
"""Columns of the three counts."""

PLACE = "split", "approach", "category", "cell_width", "scene", "viewpoint_set"
"""Columns that identify a row of trials.csv."""

SUFFIXES = {"": "counts", "_seen": "seen", "_shuffled": "shuffled"}
"""Fields of `Report` by the suffix of the columns that hold their counts."""

COLUMNS = [*PLACE, *(f"{name}{suffix}" for suffix in SUFFIXES for name in PIXELS)]
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


class OtherVersionError(UserError):
    """Records of another version of the format."""


class Records(NamedTuple):
    """Records of an evaluation.

    Attributes:
        trials: content of trials.csv, with numbers instead of text.
        about: content of evaluation.json.
    """

    trials: pd.DataFrame
    about: dict[str, Any]


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


def read(folder: Path) -> Records:
    """Read the records in the folder of the results.

    Raises:
        FileNotFoundError: if a file is missing.
        UserError: if a file is damaged or of another version.
    """
    about = read_about(folder / FOLDER / ABOUT)
    return Records(read_trials(folder / FOLDER / TRIALS), about)


def read_scenes(folder: Path) -> list[str]:
    """Return the names of the scenes to evaluate; empty without the file.

    Raises:
        ValueError: if the file is damaged.
    """
    path = folder / FOLDER / SCENES
    return [row["scene"] for row in read_csv(path) if "scene" in row] if path.is_file() else []


def read_trials(path: Path) -> pd.DataFrame:
    """Read a trials.csv.

    Raises:
        FileNotFoundError: if the file is missing.
        UserError: if a column is missing, or a value is not a valid count or cell width.
    """
    try:
        return trials_frame(read_csv(path))
    except FileNotFoundError:
        raise
    except Exception as error:  # the csv module and pandas raise various exceptions on damaged files
        raise UserError(f"{path}: is damaged ({error}); run the evaluation again to write it") from error


def trials_frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return the rows of trials.csv with numbers instead of text.

    Raises:
        ValueError: if there is no row, a column is missing, a value is out of range, or two rows are of the same trial.
    """
    if not rows:
        raise ValueError("got no trials, expected at least one")
    frame = pd.DataFrame(rows)
    if missing := [name for name in COLUMNS if name not in frame]:
        raise ValueError(f"got no column {missing[0]}, expected the columns {', '.join(COLUMNS)}")
    frame = frame[COLUMNS].copy()
    frame["cell_width"] = [
        check_range("cell_width", float(text), 0.0, 1e3, "m") for text in frame["cell_width"]
    ]
    for name in COLUMNS[len(PLACE) - 1 :]:  # the viewpoint set and the counts
        frame[name] = np.array([_count(name, text) for text in frame[name]], np.int64)
    for suffix in SUFFIXES:
        correct, gt = frame[f"correct_pixels{suffix}"], frame[f"gt_pixels{suffix}"]
        if (correct > gt).any():
            row = frame.index[correct > gt][0]
            raise ValueError(
                f"row {row + 2}: got {correct[row]} correct{suffix} of {gt[row]} ground-truth pixels"
            )
    if (twice := frame.duplicated(list(PLACE))).any():
        raise ValueError(f"row {frame.index[twice][0] + 2}: got a trial that an earlier row has as well")
    return frame


def _count(name: str, text: Any) -> int:
    if not 0 <= (value := int(text)) <= MAX_PIXELS:
        raise ValueError(f"{name}: got {value}, expected 0 to {MAX_PIXELS}")
    return value


NUMBERS = {
    ("seed",): (0, 2**63),
    ("resolution",): (0.005, 1.0),
    ("seconds",): (0.0, 1e9),
    ("protocol", "seed"): (0, 2**63),
    ("protocol", "resamples"): (10, 10**9),
    ("protocol", "viewpoint_sets"): (1, 10_000),
    ("protocol", "orientations"): (1, 1000),
    ("viewpoints", "sets"): (0, 10**9),
    ("viewpoints", "empty"): (0, 10**9),
    ("viewpoints", "viewpoints"): (0, 10**9),
    ("viewpoints", "moved"): (0.0, 1e6),
}
"""Ranges of the numbers in evaluation.json."""

NODES: Mapping[str, type] = {
    **dict.fromkeys(("protocol", "approaches", "scenes", "left_out", "viewpoints"), dict),
    **dict.fromkeys(("first_person", "provenance"), dict),
    **dict.fromkeys(("selected", "networks", "credits"), list),
    **dict.fromkeys(("sensor", "precision", "folder"), str),
}
"""Types of the other values in evaluation.json."""


def read_about(path: Path) -> dict[str, Any]:
    """Read an evaluation.json.

    Raises:
        FileNotFoundError: if the file is missing.
        OtherVersionError: if it is of another version.
        UserError: if a value has the wrong type or range.
    """
    try:
        with open(path) as file:
            about: Any = json.loads(file.read(16 * MAX_BYTES))
        version = _expect("content", about, dict).get("version")
        if version == VERSION:
            _check_about(about)
    except FileNotFoundError:
        raise
    except Exception as error:  # the json module raises various exceptions on damaged files
        raise UserError(f"{path}: is damaged ({error}); run the evaluation again to write it") from error
    if version != VERSION:
        raise OtherVersionError(
            f"{path}: got records of version {version!r}, expected {VERSION}; evaluate the checkpoint again with "
            "python -m imagination.evaluate ckpt=…"
        )
    return dict(about)


def _check_about(about: Mapping[str, Any]) -> None:
    """Check types and ranges of the values in evaluation.json.

    Raises:
        ValueError: on the first wrong value.
    """
    for name, kind in NODES.items():
        if not isinstance(about.get(name), kind):
            raise ValueError(f"{name}: got {about.get(name)!r}, expected {kind.__name__}")
    for keys, (low, high) in NUMBERS.items():
        node: Any = about
        for key in keys:
            node = node.get(key)
        _check_number(".".join(keys), node, low, high)
    for width in _expect("protocol.cell_widths", about["protocol"].get("cell_widths"), list):
        _check_number("protocol.cell_widths", width, 0.0, 1e3)
    for name, approach in about["approaches"].items():
        for key in ("rule", "postprocess"):
            _expect(f"approaches.{name}.{key}", _expect(name, approach, dict).get(key), str)
    for selected in about["selected"]:
        for key in ("approach", "category"):
            _expect(f"selected.{key}", _expect("selected", selected, dict).get(key), str)
        for key, high in (("threshold", 1.0), ("kernel", 100.0), ("iou", 1.0)):
            _check_number(f"selected.{key}", selected.get(key), 0.0, high)
    for name in ("scenes", "left_out", "first_person"):
        for value in about[name].values():
            _check_number(name, value, 0, 10**9)
    _check_texts("provenance", [about["provenance"]])
    _check_texts("networks", about["networks"])
    _check_texts("credits", about["credits"], Credit._fields)


def _check_texts(name: str, rows: Iterable[Any], columns: Sequence[str] | None = None) -> None:
    """Check that rows hold text only, and the same columns each."""
    for row in rows:
        columns = columns or list(_expect(name, row, dict))
        if list(_expect(name, row, dict)) != list(columns):
            raise ValueError(f"{name}: got the columns {', '.join(row)}, expected {', '.join(columns)}")
        for value in row.values():
            _expect(name, value, str)


def _expect(name: str, value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{name}: got {value!r}, expected {kind.__name__}")
    return value


def _check_number(name: str, value: Any, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{name}: got {value!r}, expected a number")
    check_range(name, value, low, high)
