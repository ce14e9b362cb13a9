"""What a results folder holds: counts of every run, read from tables/trials.csv or recounted from the saved maps."""

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
from imagination.utils.tabular import read_csv

log = logging.getLogger(__name__)

MAX_RESAMPLES = 100_000
"""Beyond, intervals no longer change, and take long."""

MAX_NAMED = 60
"""Scenes that are missing; a study of the paper's size has as many."""

MAX_PIXELS = 10**12
"""Of a count: sums of many stay exact."""

Row = dict[str, str]

Runs = dict[tuple[str, int], Int64[np.ndarray, "3"]]
"""Correct, false and truth pixels by scene and viewpoint set."""

ConfusionCounts = Int64[np.ndarray, "t 3"]
"""Correct, false and truth cells at thresholds .01, .02, … .99."""


class Results:
    """A run's folder, an evaluation's or a study's: whatever of it is there.

    Each part is read at its first use; what is missing or damaged is told in `problems` and left out.

    Args:
        folder: of the run.

    Raises:
        UserError: if it is no folder of a run, or its config cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.problems: list[str] = []
        self.config = read_config(folder / CONFIG)

    @property
    def name(self) -> str:
        return str(self.config.get("name", self.folder.name))

    @property
    def source(self) -> str:
        """Name of the scene source's class."""
        return str(at(self.config, "data.scenes._target_") or "scenes").rpartition(".")[2]

    @property
    def predicts(self) -> str:
        """What a run's network gives: egocentric "maps", or first-person "images"."""
        return str(at(self.config, "model.predicts") or "")

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes that anything was measured in."""
        return list(dict.fromkeys(scene for runs in self.counts.values() for scene, _ in runs))

    @property
    def resolution(self) -> float:
        """Metres per cell."""
        return float(at(self.config, "scale.resolution") or "nan")

    @property
    def resamples(self) -> int:
        """Bootstrap resamples of scenes."""
        return min(int(at(self.config, "evaluation.resamples") or 2000), MAX_RESAMPLES)

    @property
    def seed(self) -> int:
        """Of the bootstrap."""
        return int(at(self.config, "evaluation.seed") or 0)

    @cached_property
    def counts(self) -> dict[Key, Runs]:
        """Counts of every run that is there; told in `problems` what is not."""
        found = self._from_table()
        if not found and self.maps:
            self.problems.append(
                f"tables/trials.csv is missing: counted again from the maps saved so far, of {self._homes_so_far()}"
            )
            found = recount(self.maps)
        elif not found:
            self.problems.append("tables/trials.csv is missing: the evaluation has not ended, or failed")
        self.problems += missing_runs(found, self.config)
        return found

    @cached_property
    def maps(self) -> list[SavedMaps]:
        """The saved maps of all runs, by scene, cell width (widest first) and viewpoint set."""
        paths = sorted((self.folder / saved_maps.FOLDER).glob("*.npz"))
        loaded = [maps for path in paths if (maps := self._tell(saved_maps.load, path)) is not None]
        return sorted(loaded, key=lambda maps: (maps.trial.scene, -maps.trial.cell_width, maps.trial.number))

    @cached_property
    def singles(self) -> tuple[list[SingleView], float]:
        """The single views to show and the metres per cell."""
        path = self.folder / single_views.FILE
        return (path.is_file() and self._tell(single_views.load, path)) or ([], self.resolution)

    @cached_property
    def view_tallies(self) -> dict[tuple[str, str, str], ConfusionCounts]:
        """Counts of single views at every threshold, by approach (or "network"), kind of cells and category."""
        path = self.folder / "tables" / single_views.TABLE
        return (path.is_file() and self._tell(read_tallies, path)) or {}

    @cached_property
    def by_cells(self) -> dict[Key, tuple[float, float]]:
        """Pooled IoU in the cells that a view of the run saw, and in the others, as in mapping.csv."""
        path = self.folder / "tables" / "mapping.csv"
        return (path.is_file() and self._tell(read_by_cells, path)) or {}

    @cached_property
    def validated(self) -> dict[tuple[str, str], float]:
        """Pooled IoU on validation scenes of each approach and category, by which its threshold was chosen."""
        path = self.folder / "tables" / "mapping.csv"
        return (path.is_file() and self._tell(read_validated, path)) or {}

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """Command, seed, hardware, seconds and sensor of the evaluation, where they were written."""
        path = self.folder / "tables" / PROVENANCE
        return (path.is_file() and self._tell(read_provenance, path)) or {}

    def table(self, name: str) -> list[Row]:
        """A table of the folder; without rows where it is not there."""
        path = self.folder / "tables" / name
        return (path.is_file() and self._tell(read_csv, path)) or []

    @cached_property
    def trained(self) -> list["Results"]:
        """The runs that trained the networks: this one, or those of an evaluation's checkpoints, if still there."""
        given = self.config.get("ckpt")
        if given is None:
            return [self]
        found = []
        for path in [given] if isinstance(given, str) else given:
            with suppress(UserError, OSError):  # moved, deleted or damaged
                found.append(Results(Path(str(path)).parent.parent))
        return found

    @property
    def approaches(self) -> list[str]:
        return list(dict.fromkeys(key.approach for key in self.counts))

    @property
    def left_out(self) -> list[str]:
        """Approaches of the config that were not evaluated, since no network for them was given."""
        asked = at(self.config, "evaluation.approaches") or {}
        return [name for name in asked if name not in self.approaches]

    @property
    def categories(self) -> list[str]:
        return list(dict.fromkeys(key.category for key in self.counts))

    @property
    def cell_widths(self) -> list[float]:
        """Widest first, as in the paper."""
        return sorted({key.cell_width for key in self.counts}, reverse=True)

    def _homes_so_far(self) -> str:
        """How many scenes have maps, of how many that were to be measured, and which have none."""
        there = {saved.trial.scene for saved in self.maps}
        asked = [row["scene"] for row in self.table(SCENES) if "scene" in row]
        if not (lost := [scene for scene in asked if scene not in there]):
            return f"{len(there)} scenes"
        return f"{len(there)} of {len(asked)} scenes; missing: {first_of(lost, MAX_NAMED)}"

    def _from_table(self) -> dict[Key, Runs]:
        path = self.folder / "tables" / "trials.csv"
        return (path.is_file() and self._tell(read_counts, path)) or {}

    def _tell(self, read: Any, path: Path) -> Any:
        """What `read` makes of a file; None, and the file named in `problems`, if it is damaged."""
        try:
            return read(path)
        except Exception as error:  # readers raise anything on a damaged file
            self.problems.append(f"{path.relative_to(self.folder)} is damaged and left out ({error})")
            return None


def read_counts(path: Path) -> dict[Key, Runs]:
    """The counts in a trials.csv.

    Raises:
        ValueError: if they are none.
    """
    counts: dict[Key, Runs] = {}
    for row in read_csv(path):
        key = Key(row["approach"], row["category"], _width(row))
        pixels = _counts(row, "pixels")
        counts.setdefault(key, {})[row["scene"], int(row["viewpoint_set"])] = np.array(pixels, np.int64)
    return counts


def read_tallies(path: Path) -> dict[tuple[str, str, str], ConfusionCounts]:
    """The counts in a thresholds.csv.

    Raises:
        ValueError: if they are none, or a threshold is missing.
    """
    found: dict[tuple[str, str, str], list[list[int]]] = {}
    for row in read_csv(path):
        found.setdefault((row["approach"], row["cells"], row["category"]), []).append(_counts(row, "cells"))
    if any(len(rows) != len(THRESHOLDS) for rows in found.values()):
        raise ValueError(f"expected {len(THRESHOLDS)} thresholds each")
    return {key: np.array(rows, np.int64) for key, rows in found.items()}


def read_by_cells(path: Path) -> dict[Key, tuple[float, float]]:
    """IoU in seen and in unseen cells of a mapping.csv.

    Raises:
        ValueError: if they are none.
    """
    return {
        Key(row["approach"], row["category"], _width(row)):
        (float(row["iou_seen"]), float(row["iou_unseen"]))
        for row in read_csv(path)
    }  # fmt: skip


def read_validated(path: Path) -> dict[tuple[str, str], float]:
    """IoU on validation scenes in a mapping.csv.

    Raises:
        ValueError: if it is none.
    """
    return {(row["approach"], row["category"]): float(row["iou_val"]) for row in read_csv(path)}


def _width(row: Row) -> float:
    return check_range("cell_width", float(row["cell_width"]), 0.0, 1e3, "m")


def _counts(row: Row, what: str) -> list[int]:
    """Correct, false and truth pixels or cells of a row."""
    correct, false, truth = found = [int(row[f"{name}_{what}"]) for name in ("correct", "false", "truth")]
    if not (0 <= correct <= truth <= MAX_PIXELS and 0 <= false <= MAX_PIXELS):
        raise ValueError(f"got {correct} correct, {false} false and {truth} truth {what}")
    return found


def recount(maps: Sequence[SavedMaps]) -> dict[Key, Runs]:
    """The counts of every run from its saved maps."""
    counts: dict[Key, Runs] = {}
    for saved in maps:
        predicted = saved.predicted
        for place, approach in enumerate(saved.approaches):
            for layer, category in enumerate(saved.categories):
                if saved.present[layer]:
                    key = Key(approach, category, saved.trial.cell_width)
                    pixels = count(predicted[place, layer], saved.truth[layer])
                    counts.setdefault(key, {})[saved.trial.scene, saved.trial.number] = pixels
    return counts


def by_home(runs: Runs) -> Int64[np.ndarray, "scenes 1 3"]:
    """Counts summed over the viewpoint sets of each scene: what pooled figures and the bootstrap need."""
    scenes: dict[str, np.ndarray] = {}
    for (scene, _), pixels in runs.items():
        scenes[scene] = scenes.get(scene, np.zeros(3, np.int64)) + pixels
    return np.stack(list(scenes.values()))[:, None]


def missing_runs(counts: Mapping[Key, Runs], config: Mapping[str, Any]) -> list[str]:
    """Which runs a config asks for that are not there, one line for each approach, category and cell width."""
    if not counts:
        return []  # said already
    sets = range(int(at(config, "evaluation.viewpoint_sets") or 0))
    told = []
    for category in config.get("unit_categories") or []:
        of_category = [runs for key, runs in counts.items() if key.category == category]
        scenes = dict.fromkeys(scene for runs in of_category for scene, _ in runs)
        if not scenes:
            told.append(f"{category}: no run of any approach")
        measured = dict.fromkeys(key.approach for key in counts)
        for width, approach in product(at(config, "evaluation.cell_widths") or [], measured):
            runs = counts.get(Key(approach, category, float(width)), {})
            if lost := [
                (scene, number) for scene in scenes for number in sets if (scene, number) not in runs
            ]:
                names = ", ".join(f"{scene} set {number}" for scene, number in lost[:3])
                told.append(
                    f"{approach}, {category}, cell width {float(width):g} m: {len(lost)} of "
                    f"{len(scenes) * len(sets)} runs missing ({names}{', …' if len(lost) > 3 else ''})"
                )
    return told


def missing_maps(counts: Mapping[Key, Runs], maps: Sequence[SavedMaps]) -> list[str]:
    """A line on the runs that were counted and whose maps are not there; none if all are."""
    there = {saved.trial for saved in maps}
    counted = dict.fromkeys(
        Trial(scene, key.cell_width, number) for key, runs in counts.items() for scene, number in runs
    )
    lost = [run for run in counted if run not in there]
    if not lost:
        return []
    names = ", ".join(f"{run.scene} {run.cell_width:g} m set {run.number}" for run in lost[:3])
    more = ", …" if len(lost) > 3 else ""
    return [f"maps/: those of {len(lost)} of {len(counted)} runs are missing ({names}{more})"]


def read_provenance(path: Path) -> dict[str, Any]:
    """What a provenance.json says.

    Raises:
        ValueError: if it is none.
    """
    found = json.loads(path.read_text())
    if not isinstance(found, dict):
        raise ValueError(f"got {type(found).__name__}, expected keys and values")
    check_number("seconds", found.get("seconds", 0.0), 0.0, 1e9)
    return found
