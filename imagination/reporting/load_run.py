"""Reader of a results folder: counts of every trial from its records, or recounted from the saved maps."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from imagination.evaluation import read_records, saved_maps, single_views
from imagination.evaluation.read_records import ConfusionCounts, OtherVersionError, Records
from imagination.evaluation.record_files import FOLDER, TRIAL_KEY
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.single_views import SingleView
from imagination.reporting.incomplete_run import missing_trials, recount
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
    def has_seed_folders(self) -> bool:
        """Whether this is the folder of a study with several training seeds."""
        return self.parts != [self]

    @property
    def all_problems(self) -> list[str]:
        """Problems of this folder and of the evaluations of its training seeds."""
        others = [part for part in self.parts if part is not self]
        return self.problems + [f"{part.folder.name}: {text}" for part in others for text in part.problems]

    @cached_property
    def records(self) -> Records | None:
        """Records of one evaluation; None if they are missing, damaged or of another version."""
        return self._read(read_records.read, self.folder / FOLDER, self.folder)

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
                reason = "; ".join(part.problems) or f"{part.folder / FOLDER}/ is missing or incomplete"
                raise UserError(f"folder: got {self.folder}, expected the records of an evaluation; {reason}")

    @cached_property
    def trials(self) -> pd.DataFrame:
        """Counts of every trial in test scenes and training seed, see `record_files`; with a column `seed`.

        Missing trials are reported in `problems`.
        """
        if self.has_seed_folders:
            frames = [part.trials for part in self.parts]
            return pd.concat([frame for frame in frames if len(frame)] or frames[:1], ignore_index=True)
        if self.records is not None:
            trials = self._of_split("test")
        else:
            trials = recount(self.maps)
            if not any(text.startswith(f"{FOLDER}/") for text in self.problems):
                self.problems.append(f"{FOLDER}/ is incomplete: {self._reason(len(trials))}")
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
        return pd.concat(known, ignore_index=True) if known else pd.DataFrame(columns=["seed", *TRIAL_KEY])

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
        if self.has_seed_folders:
            return self.parts[0].maps
        paths = sorted((self.folder / saved_maps.FOLDER).glob("*.npz"))
        loaded = [maps for path in paths if (maps := self._read(saved_maps.load, path)) is not None]
        return sorted(loaded, key=lambda maps: (maps.trial.scene, -maps.trial.cell_width, maps.trial.number))

    @cached_property
    def single_views(self) -> tuple[list[SingleView], float]:
        """Single views for the figures, and the metres per cell."""
        if self.has_seed_folders:
            return self.parts[0].single_views
        return self._read(single_views.load, self.folder / single_views.FILE) or ([], self.resolution)

    @cached_property
    def view_counts(self) -> dict[tuple[str, str, str], ConfusionCounts]:
        """Counts of single views at every threshold by approach (or "network"), subset of cells and category."""
        if self.has_seed_folders:
            return self.parts[0].view_counts
        return self._read(read_records.read_view_counts, self.folder / FOLDER / single_views.TABLE) or {}

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
        if self.has_seed_folders:
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
        expected = self._read(lambda _: read_records.read_scenes(self.folder), self.folder) or []
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
