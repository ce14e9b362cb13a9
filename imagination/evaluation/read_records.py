"""Reader of an evaluation's records, which checks every value; see `record_files`."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Int64

from imagination.evaluation.record_files import (
    ABOUT,
    COLUMNS,
    FOLDER,
    MAX_PIXELS,
    ROW_KEY,
    SCENES,
    SUFFIXES,
    TRIALS,
    VERSION,
)
from imagination.evaluation.threshold_selection import THRESHOLDS
from imagination.scenes.source import Credit
from imagination.utils.errors import UserError, check_range
from imagination.utils.tabular import MAX_BYTES, read_csv

ConfusionCounts = Int64[np.ndarray, "t 3"]
"""Correct, false-positive and ground-truth cells at the thresholds .01, .02, … .99."""


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
    for name in COLUMNS[len(ROW_KEY) - 1 :]:  # the viewpoint set and the counts
        frame[name] = np.array([_count(name, text) for text in frame[name]], np.int64)
    for suffix in SUFFIXES:
        correct, gt = frame[f"correct_pixels{suffix}"], frame[f"gt_pixels{suffix}"]
        if (correct > gt).any():
            row = frame.index[correct > gt][0]
            raise ValueError(
                f"row {row + 2}: got {correct[row]} correct{suffix} of {gt[row]} ground-truth pixels"
            )
    if (twice := frame.duplicated(list(ROW_KEY))).any():
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


def read_view_counts(path: Path) -> dict[tuple[str, str, str], ConfusionCounts]:
    """Read the counts in a thresholds.csv.

    Raises:
        ValueError: if a value is not a valid count, or a threshold is missing.
    """
    counts: dict[tuple[str, str, str], list[list[int]]] = {}
    for row in read_csv(path):
        correct, false, gt = cells = [
            int(row[name]) for name in ("correct_cells", "false_positives", "gt_cells")
        ]
        if not (0 <= correct <= gt <= MAX_PIXELS and 0 <= false <= MAX_PIXELS):
            raise ValueError(f"got {correct} correct, {false} false-positive and {gt} ground-truth cells")
        counts.setdefault((row["approach"], row["cells"], row["category"]), []).append(cells)
    if any(len(rows) != len(THRESHOLDS) for rows in counts.values()):
        raise ValueError(
            f"expected {len(THRESHOLDS)} thresholds for each approach, category and subset of cells"
        )
    return {key: np.array(rows, np.int64) for key, rows in counts.items()}
