"""A sweep's folder: its members and what was swept."""

import csv
import json
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import islice, product
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser

from imagination.config.overrides import leaves
from imagination.reporting.load_run import Results
from imagination.runs import sweep_jobs
from imagination.utils.errors import UserError
from imagination.utils.tabular import read_csv, read_yaml

WHERE_AND_HOW = ("paths", "choices", "callbacks", "logger", "sweep_dir")
"""Nodes of a config that say where and how a member ran; they differ between members or follow from others."""


MAX_JOBS = 100_000
"""Of a sweep, as its files may ask for them."""


class Job(NamedTuple):
    """One run of a sweep.

    Attributes:
        number: name of its folder.
        results: what its folder holds; None if there is nothing to read.
        state: complete, incomplete, failed, unfinished or missing.
        reason: in a line, unless it is complete.
        asked: its overrides that were swept, where they are known.
    """

    number: str
    results: Results | None
    state: str
    reason: str
    asked: dict[str, str]


class Multirun:
    """A sweep's folder.

    Args:
        folder: with a numbered folder for each member.

    Raises:
        UserError: if none of them can be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        listed = list_of(folder / sweep_jobs.FILE)
        asked = [asked for asked, _, _ in listed] or grid(folder / "multirun.yaml")
        last = max([len(asked) - 1, *numbered(folder)])
        self.jobs = [
            job(
                folder / str(number),
                asked[number] if number < len(asked) else {},
                listed[number][1:] if number < len(listed) else ("", ""),
            )
            for number in range(last + 1)
        ]
        if not self.read:
            raise UserError(f"report: none of the {len(self.jobs)} members of {folder} has a config to read")

    @property
    def read(self) -> list[Job]:
        """Members whose config can be read."""
        return [job for job in self.jobs if job.results is not None]

    @cached_property
    def swept(self) -> dict[str, dict[str, str]]:
        """The value of everything that was swept, by key and number of the member."""
        configs = {job.number: job.results.config for job in self.read if job.results}
        by_choice = {number: _choices(config) for number, config in configs.items()}
        if found := _differing(by_choice):
            return found
        by_key = {number: _values(config) for number, config in configs.items()}
        return _independent(_differing(by_key))

    def values(self, job: Job) -> dict[str, str]:
        """What was swept of one member; of one that left no config, as its sweep asked for it."""
        return {key: of.get(job.number, job.asked.get(key, "?")) for key, of in self.swept.items()}


def is_multirun(folder: Path) -> bool:
    """Whether a folder is a sweep's: it has numbered folders, and no config of its own."""
    return bool(numbered(folder))


def numbered(folder: Path) -> list[int]:
    """Numbers of the folders in it that are named by one."""
    names = [path.name for path in folder.iterdir() if path.is_dir() and path.name.isdecimal()]
    return [number for number in map(int, names) if number < MAX_JOBS]


def grid(path: Path) -> list[dict[str, str]]:
    """The overrides of every member that a sweep's multirun.yaml asks for, in the order of their numbers.

    Empty where there is no such file or its sweeper is not Hydra's own, whose members are known beforehand.
    """
    try:
        asked = read_yaml(path)["hydra"]
        if not asked["sweeper"]["_target_"].endswith("BasicSweeper"):
            return []
        texts = [*(f"{key}={value}" for key, value in (asked["sweeper"]["params"] or {}).items())]
        texts += asked["overrides"]["task"]
        parsed = [
            each for each in OverridesParser.create().parse_overrides(texts) if each.is_sweep_override()
        ]
        lists = [
            [(each.key_or_group, text) for text in islice(each.sweep_string_iterator(), MAX_JOBS)]
            for each in parsed
        ]
        return [dict(choice) for choice in islice(product(*lists), MAX_JOBS)]
    except Exception:  # missing or damaged: then the folders alone tell
        return []


def list_of(path: Path) -> list[tuple[dict[str, str], str, str]]:
    """Overrides, state and problem of each member, in the order of their folders, as a sweep's jobs.csv has them.

    Empty where there is no such file.

    Raises:
        UserError: if it is damaged.
    """
    if not path.is_file():
        return []
    try:
        rows = sorted(read_csv(path), key=lambda row: int(row["folder"]))
        told = [(_overrides(shlex.split(row["overrides"])), row["state"], row["problem"]) for row in rows]
    except (ValueError, KeyError, csv.Error) as error:
        raise UserError(
            f"sweep {path}: is damaged ({error}); delete it to go by the folders alone"
        ) from error
    every = {str(number): values for number, (values, _, _) in enumerate(told)}
    kept = _differing(every)
    return [
        ({key: of[str(number)] for key, of in kept.items()}, state, problem)
        for number, (_, state, problem) in enumerate(told)
    ]


def job(folder: Path, asked: dict[str, str], told: tuple[str, ...] = ("", "")) -> Job:
    """One member, and how far it came; `told` is its state and problem as the sweep itself has them."""
    state, problem = told
    if state == "failed":
        with suppress(UserError):  # it left no config, or a damaged one
            return Job(folder.name, Results(folder), "failed", problem, asked)
        return Job(folder.name, None, "failed", problem, asked)
    if not folder.is_dir():
        return Job(folder.name, None, "missing", "has no folder: it was never started, or was deleted", asked)
    try:
        results = Results(folder)
    except UserError as error:
        return Job(folder.name, None, "failed", str(error).partition(";")[0], asked)
    if results.counts and not results.problems:
        return Job(folder.name, results, "complete", "", asked)
    if results.counts:
        return Job(folder.name, results, "incomplete", "; ".join(results.problems), asked)
    log = folder / "run.log"
    text = log.read_text(errors="replace") if log.is_file() else ""
    if "The run failed" in text:
        return Job(folder.name, results, "failed", text.strip().splitlines()[-1], asked)
    return Job(folder.name, results, "unfinished", "left no results: it still runs, or was stopped", asked)


def _choices(config: Mapping[str, Any]) -> dict[str, str]:
    """A member's own overrides, by key."""
    return _overrides([str(text) for text in config.get("choices") or []])


def _overrides(texts: Sequence[str]) -> dict[str, str]:
    parts = [text.lstrip("+~").partition("=") for text in texts]
    return {key: value for key, _, value in parts}


def _differing(by_number: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, str]]:
    """Keys whose value differs between members."""
    keys = dict.fromkeys(key for values in by_number.values() for key in values)
    found = {key: {number: values.get(key, "–") for number, values in by_number.items()} for key in keys}
    return {key: of for key, of in found.items() if len(set(of.values())) > 1}


def _independent(found: Mapping[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """Of keys that tell the members apart in the same way, as references do, the one highest in the config."""
    kept: dict[tuple[int, ...], str] = {}
    for key in sorted(found, key=lambda key: (key.count("."), len(key))):
        values = list(found[key].values())
        kept.setdefault(tuple(values.index(value) for value in values), key)
    return {key: found[key] for key in kept.values()}


def _values(config: Mapping[str, Any]) -> dict[str, str]:
    """A member's config as text, without where and how it ran."""
    told = {node: value for node, value in config.items() if node not in WHERE_AND_HOW}
    return {
        key: value if isinstance(value, str) else json.dumps(value, default=str)
        for key, value in leaves(told)
    }
