"""Reader of a results folder: counts of every trial from tables/trials.csv, or recounted from the saved maps."""

import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from imagination.evaluation import saved_maps, single_views
from imagination.evaluation.metrics import count
from imagination.evaluation.records import SCENES, Key
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.single_views import SingleView
from imagination.evaluation.threshold_selection import THRESHOLDS
from imagination.evaluation.trials import Trial
from imagination.reporting.mapping_report import PROVENANCE
from imagination.reporting.saved_config import at, check_number, read_config
from imagination.runs.folder import CONFIG
from imagination.utils.errors import UserError, check_range, first_of
from imagination.utils.tabular import Row, read_csv

log = logging.getLogger(__name__)

MAX_RESAMPLES = 100_000
"""Maximum number of bootstrap resamples; more do not change the intervals."""

MAX_NAMED = 60
"""Maximum number of missing scenes that a message names: as many as a study at the paper's scale evaluates."""

MAX_PIXELS = 10**12
"""Maximum pixel count of a trial, so that sums of counts stay exact."""

TrialCounts = dict[tuple[str, int], Int64[np.ndarray, "3"]]
"""Correct, false-positive and ground-truth pixels by scene and viewpoint set."""

ConfusionCounts = Int64[np.ndarray, "t 3"]
"""Correct, false-positive and ground-truth cells at the thresholds .01, .02, … .99."""


class Results:
    """Contents of the folder of a run, an evaluation or a study.

    Each part is read on first use. Missing or damaged parts are left out and reported in `problems`.

    Args:
        folder: folder of the run.

    Attributes:
        problems: messages on missing and damaged parts.
        config: config of the run.

    Raises:
        UserError: if it is not the folder of a run, or its config cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.problems: list[str] = []
        self.config = read_config(folder / CONFIG)

    @property
    def name(self) -> str:
        """Name of the run."""
        return str(self.config.get("name", self.folder.name))

    @property
    def source(self) -> str:
        """Class name of the scene source."""
        return str(at(self.config, "data.scenes._target_") or "scenes").rpartition(".")[2]

    @property
    def kind(self) -> str:
        """Kind of the run's network, one of `TaskKind`; empty if the config does not hold it."""
        return str(at(self.config, "model.predicts") or "")

    @property
    def scenes(self) -> list[str]:
        """Names of the evaluated scenes."""
        return list(dict.fromkeys(scene for trials in self.counts.values() for scene, _ in trials))

    @property
    def resolution(self) -> float:
        """Metres per cell."""
        return float(at(self.config, "ego.resolution") or "nan")

    @property
    def resamples(self) -> int:
        """Number of bootstrap resamples of scenes."""
        return min(int(at(self.config, "evaluation.resamples") or 2000), MAX_RESAMPLES)

    @property
    def seed(self) -> int:
        """Seed of the bootstrap."""
        return int(at(self.config, "evaluation.seed") or 0)

    @cached_property
    def counts(self) -> dict[Key, TrialCounts]:
        """Counts of every trial by approach, category and cell width; missing trials are reported in `problems`."""
        counts = self._from_table()
        if not counts and self.maps:
            self.problems.append(
                f"tables/trials.csv is missing: recounted from the saved maps of {self._evaluated_scenes()}"
            )
            counts = recount(self.maps)
        elif not counts:
            self.problems.append(
                "tables/trials.csv is missing: the evaluation has not finished or has failed"
            )
        self.problems += missing_trials(counts, self.config)
        return counts

    @cached_property
    def maps(self) -> list[SavedMaps]:
        """Saved maps of all trials, ordered by scene, cell width (widest first) and viewpoint set."""
        paths = sorted((self.folder / saved_maps.FOLDER).glob("*.npz"))
        loaded = [maps for path in paths if (maps := self._read(saved_maps.load, path)) is not None]
        return sorted(loaded, key=lambda maps: (maps.trial.scene, -maps.trial.cell_width, maps.trial.number))

    @cached_property
    def single_views(self) -> tuple[list[SingleView], float]:
        """Single views for the figures, and the metres per cell."""
        path = self.folder / single_views.FILE
        return (path.is_file() and self._read(single_views.load, path)) or ([], self.resolution)

    @cached_property
    def view_counts(self) -> dict[tuple[str, str, str], ConfusionCounts]:
        """Counts of single views at every threshold by approach (or "network"), subset of cells and category."""
        path = self.folder / "tables" / single_views.TABLE
        return (path.is_file() and self._read(read_view_counts, path)) or {}

    @cached_property
    def by_cells(self) -> dict[Key, tuple[float, float]]:
        """Pooled IoU in seen and in unseen cells by approach, category and cell width, from mapping.csv."""
        path = self.folder / "tables" / "mapping.csv"
        return (path.is_file() and self._read(read_by_cells, path)) or {}

    @cached_property
    def validated(self) -> dict[tuple[str, str], float]:
        """Pooled IoU on validation scenes by approach and category, at the selected threshold."""
        path = self.folder / "tables" / "mapping.csv"
        return (path.is_file() and self._read(read_validated, path)) or {}

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """Command, seed, hardware, seconds and sensor of the evaluation; empty without provenance.json."""
        path = self.folder / "tables" / PROVENANCE
        return (path.is_file() and self._read(read_provenance, path)) or {}

    def table(self, name: str) -> list[Row]:
        """Return the rows of a table of the folder; empty if there is no such table."""
        path = self.folder / "tables" / name
        return (path.is_file() and self._read(read_csv, path)) or []

    @cached_property
    def trained(self) -> list["Results"]:
        """Runs that trained the networks: this run, or the existing runs of an evaluation's checkpoints."""
        checkpoints = self.config.get("ckpt")
        if checkpoints is None:
            return [self]
        runs = []
        for path in [checkpoints] if isinstance(checkpoints, str) else checkpoints:
            with suppress(UserError, OSError):  # the run was moved, deleted or damaged
                runs.append(Results(Path(str(path)).parent.parent))
        return runs

    @property
    def approaches(self) -> list[str]:
        """Names of the evaluated approaches."""
        return list(dict.fromkeys(key.approach for key in self.counts))

    @property
    def left_out(self) -> list[str]:
        """Approaches of the config that were not evaluated because their network was missing."""
        configured = at(self.config, "evaluation.approaches") or {}
        return [name for name in configured if name not in self.approaches]

    @property
    def categories(self) -> list[str]:
        """Names of the evaluated categories."""
        return list(dict.fromkeys(key.category for key in self.counts))

    @property
    def cell_widths(self) -> list[float]:
        """Cell widths, metres, widest first as in the paper."""
        return sorted({key.cell_width for key in self.counts}, reverse=True)

    def _evaluated_scenes(self) -> str:
        """Describe the scenes with saved maps for a message: their number and the names of the missing scenes."""
        evaluated = {saved.trial.scene for saved in self.maps}
        expected = [row["scene"] for row in self.table(SCENES) if "scene" in row]
        if not (missing := [scene for scene in expected if scene not in evaluated]):
            return f"{len(evaluated)} scenes"
        return f"{len(evaluated)} of {len(expected)} scenes; missing: {first_of(missing, MAX_NAMED)}"

    def _from_table(self) -> dict[Key, TrialCounts]:
        path = self.folder / "tables" / "trials.csv"
        return (path.is_file() and self._read(read_counts, path)) or {}

    def _read(self, read: Any, path: Path) -> Any:
        """Return `read(path)`; if the file is damaged, report it in `problems` and return None."""
        try:
            return read(path)
        except Exception as error:  # readers raise various exceptions on damaged files
            self.problems.append(f"{path.relative_to(self.folder)} is damaged and left out ({error})")
            return None


def read_counts(path: Path) -> dict[Key, TrialCounts]:
    """Read the counts in a trials.csv.

    Raises:
        ValueError: if a value is not a valid count or cell width.
    """
    counts: dict[Key, TrialCounts] = {}
    for row in read_csv(path):
        key = Key(row["approach"], row["category"], _width(row))
        pixels = _counts(row, "pixels")
        counts.setdefault(key, {})[row["scene"], int(row["viewpoint_set"])] = np.array(pixels, np.int64)
    return counts


def read_view_counts(path: Path) -> dict[tuple[str, str, str], ConfusionCounts]:
    """Read the counts in a thresholds.csv.

    Raises:
        ValueError: if a value is not a valid count, or a threshold is missing.
    """
    counts: dict[tuple[str, str, str], list[list[int]]] = {}
    for row in read_csv(path):
        counts.setdefault((row["approach"], row["cells"], row["category"]), []).append(_counts(row, "cells"))
    if any(len(rows) != len(THRESHOLDS) for rows in counts.values()):
        raise ValueError(
            f"expected {len(THRESHOLDS)} thresholds for each approach, category and subset of cells"
        )
    return {key: np.array(rows, np.int64) for key, rows in counts.items()}


def read_by_cells(path: Path) -> dict[Key, tuple[float, float]]:
    """Read the IoU in seen and in unseen cells in a mapping.csv.

    Raises:
        ValueError: if a value is not a number.
    """
    return {
        Key(row["approach"], row["category"], _width(row)):
        (float(row["iou_seen"]), float(row["iou_unseen"]))
        for row in read_csv(path)
    }  # fmt: skip


def read_validated(path: Path) -> dict[tuple[str, str], float]:
    """Read the IoU on validation scenes in a mapping.csv.

    Raises:
        ValueError: if a value is not a number.
    """
    return {(row["approach"], row["category"]): float(row["iou_val"]) for row in read_csv(path)}


def _width(row: Row) -> float:
    return check_range("cell_width", float(row["cell_width"]), 0.0, 1e3, "m")


def _counts(row: Row, unit: str) -> list[int]:
    """Return the correct, false-positive and ground-truth pixels (or cells) of a row."""
    columns = f"correct_{unit}", "false_positives", f"gt_{unit}"
    correct, false, gt = counts = [int(row[column]) for column in columns]
    if not (0 <= correct <= gt <= MAX_PIXELS and 0 <= false <= MAX_PIXELS):
        raise ValueError(f"got {correct} correct, {false} false-positive and {gt} ground-truth {unit}")
    return counts


def recount(maps: Sequence[SavedMaps]) -> dict[Key, TrialCounts]:
    """Return the counts of every trial, computed from its saved maps."""
    counts: dict[Key, TrialCounts] = {}
    for saved in maps:
        predicted = saved.predicted
        for index, approach in enumerate(saved.approaches):
            for layer, category in enumerate(saved.categories):
                if saved.present[layer]:
                    key = Key(approach, category, saved.trial.cell_width)
                    pixels = count(predicted[index, layer], saved.truth[layer])
                    counts.setdefault(key, {})[saved.trial.scene, saved.trial.number] = pixels
    return counts


def by_scene(trials: TrialCounts) -> Int64[np.ndarray, "scenes 1 3"]:
    """Sum counts over the viewpoint sets of each scene, for the pooled IoU and the bootstrap."""
    scenes: dict[str, np.ndarray] = {}
    for (scene, _), pixels in trials.items():
        scenes[scene] = scenes.get(scene, np.zeros(3, np.int64)) + pixels
    return np.stack(list(scenes.values()))[:, None]


def missing_trials(counts: Mapping[Key, TrialCounts], config: Mapping[str, Any]) -> list[str]:
    """Return one message for each approach, category and cell width of the config that has missing trials."""
    if not counts:
        return []  # reported already
    sets = range(int(at(config, "evaluation.viewpoint_sets") or 0))
    approaches = dict.fromkeys(key.approach for key in counts)
    messages = []
    for category in config.get("unit_categories") or []:
        of_category = [trials for key, trials in counts.items() if key.category == category]
        scenes = dict.fromkeys(scene for trials in of_category for scene, _ in trials)
        if not scenes:
            messages.append(f"{category}: no trial of any approach")
        for width, approach in product(at(config, "evaluation.cell_widths") or [], approaches):
            trials = counts.get(Key(approach, category, float(width)), {})
            if missing := [
                (scene, number) for scene in scenes for number in sets if (scene, number) not in trials
            ]:
                names = ", ".join(f"{scene} set {number}" for scene, number in missing[:3])
                messages.append(
                    f"{approach}, {category}, cell width {float(width):g} m: {len(missing)} of "
                    f"{len(scenes) * len(sets)} trials missing ({names}{', …' if len(missing) > 3 else ''})"
                )
    return messages


def missing_maps(counts: Mapping[Key, TrialCounts], maps: Sequence[SavedMaps]) -> list[str]:
    """Return a message on counted trials without saved maps, or an empty list if there are none."""
    saved = {each.trial for each in maps}
    counted = dict.fromkeys(
        Trial(scene, key.cell_width, number) for key, trials in counts.items() for scene, number in trials
    )
    missing = [trial for trial in counted if trial not in saved]
    if not missing:
        return []
    names = ", ".join(f"{trial.scene} {trial.cell_width:g} m set {trial.number}" for trial in missing[:3])
    more = ", …" if len(missing) > 3 else ""
    return [f"maps/: the maps of {len(missing)} of {len(counted)} trials are missing ({names}{more})"]


def read_provenance(path: Path) -> dict[str, Any]:
    """Read a provenance.json.

    Raises:
        ValueError: if it is not a JSON object, or its seconds are not a valid number.
    """
    values = json.loads(path.read_text())
    if not isinstance(values, dict):
        raise ValueError(f"got {type(values).__name__}, expected a JSON object")
    check_number("seconds", values.get("seconds", 0.0), 0.0, 1e9)
    return values
