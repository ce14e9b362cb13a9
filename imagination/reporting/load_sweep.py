"""Reader of a sweep's folder: its jobs, the swept values, and the settings that several training seeds share."""

import csv
import json
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import islice, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from hydra.core.override_parser.overrides_parser import OverridesParser

from imagination.config.key_roles import RESULT_ROLES, role
from imagination.config.overrides import leaves
from imagination.evaluation.record_files import TRIAL_KEY
from imagination.reporting.load_run import Results
from imagination.reporting.paper_layout import Column
from imagination.runs import sweep_jobs
from imagination.utils.errors import UserError
from imagination.utils.tabular import read_csv, read_yaml

MAX_JOBS = 100_000
"""Maximum number of jobs that the files of a sweep may define."""


class Job(NamedTuple):
    """Job of a sweep.

    Attributes:
        number: name of its folder.
        results: contents of its folder; None if they cannot be read.
        state: complete, incomplete, failed, unfinished or missing.
        reason: reason for the state, one line; empty if complete.
        requested: swept overrides that the sweep requested; empty if unknown.
    """

    number: str
    results: Results | None
    state: str
    reason: str
    requested: dict[str, str]


GROUPED = ("seed", "evaluation.cell_widths")
"""Swept keys that make no settings: trainings with other random numbers, and further columns of the same table."""


@dataclass(frozen=True)
class Setting:
    """Evaluated jobs of a sweep that differ only in training seed or cell widths.

    Attributes:
        values: swept values by key, without those of `GROUPED`.
        jobs: jobs with counts of trials.
    """

    values: dict[str, str]
    jobs: list[Job]

    @property
    def name(self) -> str:
        """Swept values as text; "all jobs" if the sweep has only one setting."""
        return ", ".join(f"{key}={value}" for key, value in self.values.items()) or "all jobs"

    @cached_property
    def trials(self) -> pd.DataFrame:
        """Counts of every trial of all jobs; see `Results.trials`."""
        trials = pd.concat([results_of(job).trials for job in self.jobs], ignore_index=True)
        return trials.drop_duplicates(["seed", *TRIAL_KEY], ignore_index=True)

    def validated(self, approach: str, category: str) -> float | None:
        """Return the pooled IoU on validation scenes, mean over jobs; None if a job does not have it."""
        scores = [results_of(job).validated.get((approach, category)) for job in self.jobs]
        found = [score for score in scores if score is not None]
        return float(np.mean(found)) if len(found) == len(scores) else None


def results_of(job: Job) -> Results:
    """Return the contents of a job whose config can be read."""
    assert job.results is not None
    return job.results


class Multirun:
    """Contents of a sweep's folder.

    Args:
        folder: folder with a numbered folder for each job.

    Raises:
        UserError: if no job has results.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        listed = read_jobs(folder / sweep_jobs.FILE)
        requested = [overrides for overrides, _, _ in listed] or grid(folder / "multirun.yaml")
        last = max([len(requested) - 1, *numbered(folder)])
        self.jobs = [
            read_job(
                folder / str(number),
                requested[number] if number < len(requested) else {},
                listed[number][1:] if number < len(listed) else ("", ""),
            )
            for number in range(last + 1)
        ]
        if not self.evaluated:
            reasons = "; ".join(f"job {job.number}: {job.state}, {job.reason}" for job in self.jobs[:3])
            raise UserError(
                f"folder: got {folder}, none of whose {len(self.jobs)} jobs has results ({reasons}); run the same "
                f"sweep again with hydra.sweep.dir={folder}"
            )

    @property
    def readable(self) -> list[Job]:
        """Jobs whose config can be read."""
        return [job for job in self.jobs if job.results is not None]

    @property
    def evaluated(self) -> list[Job]:
        """Jobs with counts of trials."""
        return [job for job in self.readable if job.results is not None and len(job.results.trials)]

    @cached_property
    def settings(self) -> list[Setting]:
        """Evaluated jobs grouped by their swept values without those of `GROUPED`, in the order of the jobs."""
        grouped: dict[tuple[str, ...], Setting] = {}
        for job in self.evaluated:
            values = {key: value for key, value in self.values(job).items() if key not in GROUPED}
            grouped.setdefault(tuple(values.values()), Setting(values, [])).jobs.append(job)
        return list(grouped.values())

    @cached_property
    def approaches(self) -> list[str]:
        """Names of the evaluated approaches of all settings."""
        return list(dict.fromkeys(name for setting in self.settings for name in setting.trials["approach"]))

    @cached_property
    def columns(self) -> list[Column]:
        """Cell widths and categories of all settings, widest first."""
        trials = pd.concat([setting.trials for setting in self.settings])
        widths = sorted(trials["cell_width"].unique().tolist(), reverse=True)
        return [Column(width, category) for width in widths for category in trials["category"].unique()]

    @cached_property
    def swept(self) -> dict[str, dict[str, str]]:
        """Swept values by key and number of the job."""
        configs = {job.number: job.results.config for job in self.readable if job.results}
        overrides = {number: _choices(config) for number, config in configs.items()}
        if swept := _differing(overrides):
            return swept
        values = {number: _values(config) for number, config in configs.items()}
        return _independent(_differing(values))

    def values(self, job: Job) -> dict[str, str]:
        """Return the swept values of a job; without a config, those that the sweep requested."""
        return {
            key: values.get(job.number, job.requested.get(key, "?")) for key, values in self.swept.items()
        }


def is_multirun(folder: Path) -> bool:
    """Return whether a folder is that of a sweep, which contains numbered folders."""
    return bool(numbered(folder))


def numbered(folder: Path) -> list[int]:
    """Return the numbers of the numbered folders in a folder."""
    names = [path.name for path in folder.iterdir() if path.is_dir() and path.name.isdecimal()]
    return [number for number in map(int, names) if number < MAX_JOBS]


def grid(path: Path) -> list[dict[str, str]]:
    """Return the overrides of every job of a sweep's multirun.yaml, ordered by number.

    The list is empty without such a file, or if the sweeper is not Hydra's BasicSweeper, whose jobs form a grid.
    """
    try:
        hydra = read_yaml(path)["hydra"]
        if not hydra["sweeper"]["_target_"].endswith("BasicSweeper"):
            return []
        texts = [*(f"{key}={value}" for key, value in (hydra["sweeper"]["params"] or {}).items())]
        texts += hydra["overrides"]["task"]
        parsed = [
            each for each in OverridesParser.create().parse_overrides(texts) if each.is_sweep_override()
        ]
        lists = [
            [(each.key_or_group, text) for text in islice(each.sweep_string_iterator(), MAX_JOBS)]
            for each in parsed
        ]
        return [dict(overrides) for overrides in islice(product(*lists), MAX_JOBS)]
    except Exception:  # missing or damaged: the folders alone define the jobs
        return []


def read_jobs(path: Path) -> list[tuple[dict[str, str], str, str]]:
    """Read overrides, state and problem of each job from a sweep's jobs.csv, ordered by folder.

    The list is empty without such a file.

    Raises:
        UserError: if the file is damaged.
    """
    if not path.is_file():
        return []
    try:
        rows = sorted(read_csv(path), key=lambda row: int(row["folder"]))
        jobs = [(_overrides(shlex.split(row["overrides"])), row["state"], row["problem"]) for row in rows]
    except (ValueError, KeyError, csv.Error) as error:
        raise UserError(
            f"sweep {path}: is damaged ({error}); delete it to report on the folders alone"
        ) from error
    swept = _differing({str(number): overrides for number, (overrides, _, _) in enumerate(jobs)})
    return [
        ({key: values[str(number)] for key, values in swept.items()}, state, problem)
        for number, (_, state, problem) in enumerate(jobs)
    ]


def read_job(folder: Path, requested: dict[str, str], listed: tuple[str, ...] = ("", "")) -> Job:
    """Read a job and determine its state.

    Args:
        folder: folder of the job.
        requested: swept overrides that the sweep requested.
        listed: state and problem of the job in jobs.csv.
    """
    state, problem = listed
    if state == "failed":
        with suppress(UserError, OSError):  # no config, or a damaged one
            return Job(folder.name, Results(folder), "failed", problem, requested)
        return Job(folder.name, None, "failed", problem, requested)
    if not folder.is_dir():
        return Job(folder.name, None, "missing", "no folder: it was never started, or was deleted", requested)
    try:
        results = Results(folder)
    except (UserError, OSError) as error:
        return Job(folder.name, None, "failed", str(error).partition(";")[0], requested)
    if len(results.trials) and not results.problems:
        return Job(folder.name, results, "complete", "", requested)
    if len(results.trials):
        return Job(folder.name, results, "incomplete", "; ".join(results.problems), requested)
    log = folder / "run.log"
    text = log.read_text(errors="replace") if log.is_file() else ""
    if "The run failed" in text:
        return Job(folder.name, results, "failed", text.strip().splitlines()[-1], requested)
    return Job(folder.name, results, "unfinished", "no results: it still runs, or was stopped", requested)


def _choices(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the overrides of a job by key."""
    return _overrides([str(text) for text in config.get("choices") or []])


def _overrides(texts: Sequence[str]) -> dict[str, str]:
    """Split overrides into keys and values."""
    parts = [text.lstrip("+~").partition("=") for text in texts]
    return {key: value for key, _, value in parts}


def _differing(by_number: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, str]]:
    """Return the keys whose value differs between jobs, with their values by number of the job."""
    keys = dict.fromkeys(key for values in by_number.values() for key in values)
    by_key = {key: {number: values.get(key, "–") for number, values in by_number.items()} for key in keys}
    return {key: values for key, values in by_key.items() if len(set(values.values())) > 1}


def _independent(swept: Mapping[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """Remove keys that partition the jobs like another key, such as references; keep the one highest in the config."""
    by_partition: dict[tuple[int, ...], str] = {}
    for key in sorted(swept, key=lambda key: (key.count("."), len(key))):
        values = list(swept[key].values())
        by_partition.setdefault(tuple(values.index(value) for value in values), key)
    return {key: swept[key] for key in by_partition.values()}


def _values(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the values of a job's config that determine its results as text by key."""
    return {
        key: value if isinstance(value, str) else json.dumps(value, default=str)
        for key, value in leaves(config)
        if role(key) in RESULT_ROLES
    }
