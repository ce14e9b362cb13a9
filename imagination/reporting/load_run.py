"""Reader of a results folder: counts of every trial from its records, or recounted from the saved maps."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from jaxtyping import Int64

from imagination.evaluation import record_files, saved_maps, single_views
from imagination.evaluation.metrics import count
from imagination.evaluation.record_files import PIXELS, OtherVersionError, Records
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.single_views import SingleView
from imagination.evaluation.threshold_selection import THRESHOLDS
from imagination.evaluation.trials import Trial
from imagination.reporting.saved_config import at, read_config
from imagination.reporting.statistics import Bootstrap
from imagination.runs.final_record import FINAL
from imagination.runs.folder import CONFIG
from imagination.utils.errors import UserError, first_of
from imagination.utils.tabular import Row, read_csv

Content = TypeVar("Content")

MAX_RESAMPLES = 100_000
"""Maximum number of bootstrap resamples; more do not change the intervals."""

MAX_NAMED = 60
"""Maximum number of missing scenes that a message names: as many as a study at the paper's scale evaluates."""

TRIAL = ["approach", "category", "cell_width", "scene", "viewpoint_set"]
"""Columns that identify a trial of one training seed."""

ConfusionCounts = Int64[np.ndarray, "t 3"]
"""Correct, false-positive and ground-truth cells at the thresholds .01, .02, … .99."""


class Results:
    """Contents of the folder of a run, an evaluation or a study.

    Each part is read on first use. Missing or damaged parts are left out and reported in `problems`. A study with
    several training seeds has a folder seed_<n>/ for each; maps, single views and curves are those of the first seed.

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
        return list(self.trials["scene"].unique())

    @property
    def resolution(self) -> float:
        """Metres per cell."""
        return float(at(self.config, "ego.resolution") or "nan")

    @property
    def bootstrap(self) -> Bootstrap:
        """Bootstrap over scenes with the settings of the evaluation."""
        protocol = self.about.get("protocol") or at(self.config, "evaluation") or {}
        resamples = min(int(protocol.get("resamples") or 2000), MAX_RESAMPLES)
        return Bootstrap(resamples, int(protocol.get("seed") or 0))

    @cached_property
    def parts(self) -> list["Results"]:
        """Evaluations of the training seeds, ordered by seed: this folder, or the folders seed_<n>/ of a study."""
        seeds = self.config.get("seeds")
        if not isinstance(seeds, list) or not seeds or not all(isinstance(seed, int) for seed in seeds):
            return [self]
        parts = []
        for seed in sorted(seeds):
            with self._reported(self.folder / f"seed_{seed}"):
                parts.append(Results(self.folder / f"seed_{seed}"))
        return parts or [self]

    @property
    def all_problems(self) -> list[str]:
        """Problems of this folder and of the evaluations of its training seeds."""
        others = [part for part in self.parts if part is not self]
        return self.problems + [f"{part.folder.name}: {text}" for part in others for text in part.problems]

    @cached_property
    def records(self) -> Records | None:
        """Records of one evaluation; None if they are missing, damaged or of another version."""
        return self._read(record_files.read, self.folder / record_files.FOLDER, self.folder)

    @property
    def has_records(self) -> bool:
        """Whether the records of all training seeds can be read."""
        return all(part.records is not None for part in self.parts)

    def check_records(self) -> None:
        """Check that the records of all training seeds can be read.

        Raises:
            UserError: if records are missing or damaged.
        """
        for part in self.parts:
            if part.records is None:
                reason = (
                    "; ".join(part.problems)
                    or f"{part.folder / record_files.FOLDER}/ is missing or incomplete"
                )
                raise UserError(f"folder: got {self.folder}, expected the records of an evaluation; {reason}")

    @cached_property
    def trials(self) -> pd.DataFrame:
        """Counts of every trial in test scenes and training seed, see `record_files`; with a column `seed`.

        Missing trials are reported in `problems`.
        """
        if self.parts != [self]:
            frames = [part.trials for part in self.parts]
            return pd.concat([frame for frame in frames if len(frame)] or frames[:1], ignore_index=True)
        if self.records is not None:
            trials = self._of_split("test")
        else:
            trials = recount(self.maps)
            if not any(text.startswith(f"{record_files.FOLDER}/") for text in self.problems):
                self.problems.append(f"{record_files.FOLDER}/ is incomplete: {self._reason(len(trials))}")
        self.problems += missing_trials(trials, self.config)
        trials.insert(0, "seed", self.seed)
        return trials

    def _reason(self, counted: int) -> str:
        """Explain missing records, with what to do."""
        if counted:
            return f"recounted from the saved maps of {self._evaluated_scenes()}"
        if (self.folder / FINAL).is_file():
            return (
                "the run has no evaluation, or one of an earlier version; evaluate its checkpoint with "
                "python -m imagination.evaluate ckpt=…"
            )
        return "the evaluation has not finished or has failed; run the same command again"

    @cached_property
    def known(self) -> pd.DataFrame:
        """Counts of every trial in scenes with training furniture; empty if they were not evaluated."""
        frames = [part._of_split("known") for part in self.parts if part.records is not None]
        seeds = [part.seed for part in self.parts if part.records is not None]
        known = [frame.assign(seed=seed) for frame, seed in zip(frames, seeds, strict=True)]
        return pd.concat(known, ignore_index=True) if known else pd.DataFrame(columns=["seed", *TRIAL])

    def _of_split(self, split: str) -> pd.DataFrame:
        assert self.records is not None
        trials = self.records.trials
        return trials[trials["split"] == split].drop(columns="split").reset_index(drop=True)

    @property
    def about(self) -> dict[str, Any]:
        """Settings and provenance of the evaluation of the first seed; empty without records."""
        records = self.parts[0].records
        return records.about if records else {}

    @property
    def seed(self) -> int:
        """Training seed."""
        if self.records is not None:
            return int(self.records.about["seed"])
        value = self.config.get("seed", 0)
        return value if isinstance(value, int) and abs(value) < 2**63 else 0

    @property
    def seeds(self) -> list[int]:
        """Training seeds."""
        return [part.seed for part in self.parts]

    @cached_property
    def maps(self) -> list[SavedMaps]:
        """Saved maps of all trials, ordered by scene, cell width (widest first) and viewpoint set."""
        if self.parts != [self]:
            return self.parts[0].maps
        paths = sorted((self.folder / saved_maps.FOLDER).glob("*.npz"))
        loaded = [maps for path in paths if (maps := self._read(saved_maps.load, path)) is not None]
        return sorted(loaded, key=lambda maps: (maps.trial.scene, -maps.trial.cell_width, maps.trial.number))

    @cached_property
    def single_views(self) -> tuple[list[SingleView], float]:
        """Single views for the figures, and the metres per cell."""
        if self.parts != [self]:
            return self.parts[0].single_views
        return self._read(single_views.load, self.folder / single_views.FILE) or ([], self.resolution)

    @cached_property
    def view_counts(self) -> dict[tuple[str, str, str], ConfusionCounts]:
        """Counts of single views at every threshold by approach (or "network"), subset of cells and category."""
        if self.parts != [self]:
            return self.parts[0].view_counts
        return self._read(read_view_counts, self.folder / record_files.FOLDER / single_views.TABLE) or {}

    @property
    def validated(self) -> dict[tuple[str, str], float]:
        """Pooled IoU on validation scenes by approach and category at the selected threshold, mean over seeds."""
        scores: dict[tuple[str, str], list[float]] = {}
        for part in self.parts:
            for each in part.about.get("selected", []):
                scores.setdefault((each["approach"], each["category"]), []).append(each["iou"])
        return {key: float(np.mean(values)) for key, values in scores.items()}

    @property
    def provenance(self) -> dict[str, str]:
        """Date, version, git commit, command and processor of the evaluation; empty without records."""
        return dict(self.about.get("provenance", {}))

    def table(self, name: str) -> list[Row]:
        """Return the rows of a table of the folder; empty if there is no such table."""
        return self._read(read_csv, self.folder / "tables" / name) or []

    @cached_property
    def trained(self) -> list["Results"]:
        """Runs that trained the networks: this run, or the existing runs of an evaluation's checkpoints."""
        if self.parts != [self]:
            return [run for part in self.parts for run in part.trained]
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
        return list(self.trials["approach"].unique())

    @property
    def left_out(self) -> list[str]:
        """Approaches of the config that were not evaluated because their network was missing."""
        configured = at(self.config, "evaluation.approaches") or {}
        return [name for name in configured if name not in self.approaches]

    @property
    def categories(self) -> list[str]:
        """Names of the evaluated categories."""
        return list(self.trials["category"].unique())

    @property
    def cell_widths(self) -> list[float]:
        """Cell widths, metres, widest first as in the paper."""
        return sorted(self.trials["cell_width"].unique().tolist(), reverse=True)

    def _evaluated_scenes(self) -> str:
        """Describe the scenes with saved maps for a message: their number and the names of the missing scenes."""
        evaluated = {saved.trial.scene for saved in self.maps}
        expected = self._read(lambda _: record_files.read_scenes(self.folder), self.folder) or []
        if not (missing := [scene for scene in expected if scene not in evaluated]):
            return f"{len(evaluated)} scenes"
        return f"{len(evaluated)} of {len(expected)} scenes; missing: {first_of(missing, MAX_NAMED)}"

    def _read(
        self, read: Callable[[Path], Content], path: Path, argument: Path | None = None
    ) -> Content | None:
        """Return `read(argument)`, by default of `path`; None without the file or, after a report, if it is damaged."""
        if path.exists():
            with self._reported(path):
                return read(argument or path)
        return None

    @contextmanager
    def _reported(self, path: Path) -> Iterator[None]:
        """Report a damaged file in `problems`; a missing one is no problem."""
        try:
            yield
        except FileNotFoundError:
            pass
        except Exception as error:  # readers raise various exceptions on damaged files
            name = f"{path.relative_to(self.folder)}{'/' if path.is_dir() else ''}"
            state = "of another version" if isinstance(error, OtherVersionError) else "damaged"
            self.problems.append(f"{name} is {state} and left out ({error})")


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
        if not (0 <= correct <= gt <= record_files.MAX_PIXELS and 0 <= false <= record_files.MAX_PIXELS):
            raise ValueError(f"got {correct} correct, {false} false-positive and {gt} ground-truth cells")
        counts.setdefault((row["approach"], row["cells"], row["category"]), []).append(cells)
    if any(len(rows) != len(THRESHOLDS) for rows in counts.values()):
        raise ValueError(
            f"expected {len(THRESHOLDS)} thresholds for each approach, category and subset of cells"
        )
    return {key: np.array(rows, np.int64) for key, rows in counts.items()}


def recount(maps: Sequence[SavedMaps]) -> pd.DataFrame:
    """Return the counts of every trial over whole maps and seen cells, computed from its saved maps."""
    rows = []
    columns = [*TRIAL, *PIXELS, *(f"{name}_seen" for name in PIXELS)]
    for saved in maps:
        predicted = saved.predicted
        for (index, approach), (layer, category) in product(
            enumerate(saved.approaches), enumerate(saved.categories)
        ):
            if saved.present[layer]:
                pixels = count(predicted[index, layer], saved.truth[layer])
                seen = count(predicted[index, layer] & saved.seen, saved.truth[layer] & saved.seen)
                scene, width, number = saved.trial
                rows.append((approach, category, width, scene, number, *pixels.tolist(), *seen.tolist()))
    return pd.DataFrame(rows, columns=columns)


def missing_trials(trials: pd.DataFrame, config: Mapping[str, Any]) -> list[str]:
    """Return one message for each approach, category and cell width of the config that has missing trials."""
    if trials.empty:
        return []  # reported already
    sets = range(int(at(config, "evaluation.viewpoint_sets") or 0))
    found = set(trials[TRIAL].itertuples(index=False, name=None))
    messages = []
    for category in config.get("unit_categories") or []:
        scenes = trials[trials["category"] == category]["scene"].unique()
        if not len(scenes):
            messages.append(f"{category}: no trial of any approach")
        places = product(at(config, "evaluation.cell_widths") or [], trials["approach"].unique())
        for width, approach in places:
            expected = product(scenes, sets)
            if missing := [
                trial for trial in expected if (approach, category, float(width), *trial) not in found
            ]:
                names = ", ".join(f"{scene} set {number}" for scene, number in missing[:3])
                messages.append(
                    f"{approach}, {category}, cell width {float(width):g} m: {len(missing)} of "
                    f"{len(scenes) * len(sets)} trials missing ({names}{', …' if len(missing) > 3 else ''})"
                )
    return messages


def missing_maps(trials: pd.DataFrame, maps: Sequence[SavedMaps]) -> list[str]:
    """Return a message on counted trials without saved maps, or an empty list if there are none."""
    saved = {each.trial for each in maps}
    places = trials[["scene", "cell_width", "viewpoint_set"]].drop_duplicates()
    counted = [Trial(*place) for place in places.itertuples(index=False, name=None)]
    missing = [trial for trial in counted if trial not in saved]
    if not missing:
        return []
    names = ", ".join(f"{trial.scene} {trial.cell_width:g} m set {trial.number}" for trial in missing[:3])
    more = ", …" if len(missing) > 3 else ""
    return [f"maps/: the maps of {len(missing)} of {len(counted)} trials are missing ({names}{more})"]
