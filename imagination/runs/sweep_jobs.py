"""Table of the jobs of a sweep: jobs.csv in the folder of the sweep, one row per job, in the order of the sweep.

    folder      name of the job's folder in the folder of the sweep, created when the job starts
    key         hash of the job's resolved config, which identifies the job when the sweep is started again
    state       missing (not started), running, done, failed, or stopped (by Ctrl-C or a kill)
    score       best egocentric IoU on validation scenes if the job trains a unit, else empty
    overrides   overrides of the job, quoted as in a shell
    problem     error message of a failed job

In the file, a killed job has the state `running`, because it could not update its row; `read` returns `stopped`.
"""

import csv
import hashlib
import json
import shlex
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imagination.config.key_roles import Role, role
from imagination.runs.locking import BusyError, locked
from imagination.utils.atomic_io import PART, is_part, write_text
from imagination.utils.errors import UserError
from imagination.utils.file_lock import locked_file
from imagination.utils.tabular import csv_text, read_csv

FILE = "jobs.csv"
"""File name of the table."""


class Job(NamedTuple):
    """Row of the table."""

    folder: str
    key: str
    state: str
    score: str
    overrides: str
    problem: str


def read(sweep: Path) -> list[Job]:
    """Return the jobs of a sweep with their current state.

    Raises:
        UserError: if the folder is not that of a sweep, or the table is damaged.
    """
    if not (sweep / FILE).is_file():
        raise UserError(
            f"sweep {sweep}: got a folder without {FILE}, expected the folder of a sweep (train or evaluate with -m)"
        )
    return [
        job._replace(state="stopped") if job.state == "running" and not _is_locked(sweep, job) else job
        for job in _load(sweep)
    ]


def register(sweep: Path, key: str, overrides: Sequence[str]) -> Job:
    """Return the job with this key; a new job is added with the next number as its folder."""
    with _table_locked(sweep):
        jobs = _load(sweep)
        for job in jobs:
            if job.key == key:
                return job
        job = Job(str(len(jobs)), key, "missing", "", shlex.join(overrides), "")
        _save(sweep, [*jobs, job])
        return job


def update(sweep: Path, key: str, **changes: str) -> None:
    """Change columns of the job with this key."""
    with _table_locked(sweep):
        _save(sweep, [job._replace(**changes) if job.key == key else job for job in _load(sweep)])


def lock_name(job: Job) -> str:
    """Return the name of the lock file, in the folder of the sweep, of the process that runs a job."""
    return f".{job.folder}.lock"


def config_key(config: DictConfig, ignored: Collection[Role] = ()) -> str:
    """Return the hash of a resolved config without its folders, its cache and the version of the program.

    Args:
        config: composed config.
        ignored: roles of further keys to leave out.
    """
    values: Any = OmegaConf.to_container(config)
    values["paths"] |= {"outputs": "", "cache": "", "run": ""}  # other nodes refer to them
    values["program"] = ""
    if "ckpt" in values:  # `latest` may point to another run later
        paths = [values["ckpt"]] if isinstance(values["ckpt"], str) else values["ckpt"]
        values["ckpt"] = [str(Path(path).resolve()) for path in paths]
    with suppress(OmegaConfBaseException):  # reported when the job starts
        values = OmegaConf.to_container(OmegaConf.create(values), resolve=True)
    text = json.dumps(_without(values, {Role.LOCATION, *ignored}), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _without(node: Mapping[str, Any], roles: Collection[Role], prefix: str = "") -> dict[str, Any]:
    """Return a tree without the values whose keys have one of the roles."""
    kept = {}
    for name, value in node.items():
        if isinstance(value, dict):
            if inner := _without(value, roles, f"{prefix}{name}."):
                kept[name] = inner
        elif role(f"{prefix}{name}") not in roles:
            kept[name] = value
    return kept


def _is_locked(sweep: Path, job: Job) -> bool:
    try:
        with locked(sweep, lock_name(job)):
            return False
    except BusyError:
        return True


@contextmanager
def _table_locked(sweep: Path) -> Iterator[None]:
    """Hold an exclusive lock on the table, which other processes may change as well."""
    sweep.mkdir(parents=True, exist_ok=True)
    with locked_file(sweep / ".jobs.lock"):
        for scratch in filter(is_part, sweep.glob(f".{FILE}.*{PART}")):  # left by a killed process
            shutil.rmtree(scratch)
        yield


def _load(sweep: Path) -> list[Job]:
    if not (sweep / FILE).is_file():
        return []
    try:
        rows = read_csv(sweep / FILE)
        if any(row.keys() != set(Job._fields) for row in rows):
            raise ValueError(f"expected the columns {','.join(Job._fields)}")
        if invalid := [row["folder"] for row in rows if not row["folder"].isdecimal()]:
            raise ValueError(f"got the folder {invalid[0]!r}, expected a number")
        return [Job(**row) for row in rows]
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(
            f"{sweep / FILE}: cannot be read ({error}); restore the file, or use another folder with hydra.sweep.dir=…"
        ) from error


def _save(sweep: Path, jobs: Sequence[Job]) -> None:
    write_text(sweep / FILE, csv_text([Job._fields, *jobs]))
