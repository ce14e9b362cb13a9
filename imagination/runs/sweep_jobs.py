"""The members of a sweep: jobs.csv in the sweep's folder, one line each, in the order of the sweep.

    folder      name of the member's folder in the sweep's; it appears when the member begins
    key         hash of the member's resolved config: the same member of an earlier start has the same
    state       missing (not begun), running, done, failed, or stopped (by Ctrl-C or a kill)
    score       of a unit that was trained: its best egocentric IoU on validation scenes; else empty
    overrides   the member's command line, quoted as in a shell
    problem     why it failed

`read` gives the lines; the file itself says `running` of a member that was killed, since nobody was left to write.
"""

import csv
import fcntl
import hashlib
import io
import json
import shlex
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imagination.runs.locking import BusyError, locked
from imagination.utils.atomic_io import PART, write_text
from imagination.utils.errors import UserError
from imagination.utils.tabular import read_csv

FILE = "jobs.csv"

EVALUATION_ONLY = (
    "evaluation",
    "mapping",
    "callbacks.mapping_evaluation",
    "callbacks.unit_images",
    "scale.cell_widths",
    "scale.viewpoint_sets",
    "scale.orientations",
    "scale.eval_scenes",
)
"""Nodes that only evaluation reads."""


class Job(NamedTuple):
    """One line of the file."""

    folder: str
    key: str
    state: str
    score: str
    overrides: str
    problem: str


def read(sweep: Path) -> list[Job]:
    """The members of a sweep, as they are now.

    Raises:
        UserError: if the folder is not a sweep's.
    """
    if not (sweep / FILE).is_file():
        raise UserError(
            f"sweep {sweep}: holds no {FILE}; expected the folder of a sweep (train or evaluate with -m)"
        )
    return [
        job._replace(state="stopped") if job.state == "running" and not _held(sweep, job) else job
        for job in _load(sweep)
    ]


def register(sweep: Path, key: str, overrides: Sequence[str]) -> Job:
    """The member with this key; a new one gets the next number as its folder."""
    with _exclusively(sweep):
        jobs = _load(sweep)
        for job in jobs:
            if job.key == key:
                return job
        job = Job(str(len(jobs)), key, "missing", "", shlex.join(overrides), "")
        _save(sweep, [*jobs, job])
        return job


def update(sweep: Path, key: str, **changes: str) -> None:
    """Change what the file says of a member."""
    with _exclusively(sweep):
        _save(sweep, [m._replace(**changes) if m.key == key else m for m in _load(sweep)])


def lock_name(job: Job) -> str:
    """Name of the file in the sweep's folder that the process running the member holds."""
    return f".{job.folder}.lock"


def key_of(config: DictConfig, without: Sequence[str] = ()) -> str:
    """Hash of what a member computes: its resolved config, without the folders and the cache that it uses.

    Args:
        config: composed.
        without: nodes to leave out as well, such as "mapping" or "scale.cell_widths".
    """
    values: Any = OmegaConf.to_container(config)
    values["paths"] |= {"outputs": "", "cache": "", "run": ""}
    values["sweep_dir"] = values["cache"] = values["program"] = ""
    if "ckpt" in values:  # `latest` will be another one tomorrow
        paths = [values["ckpt"]] if isinstance(values["ckpt"], str) else values["ckpt"]
        values["ckpt"] = [str(Path(path).resolve()) for path in paths]
    with suppress(OmegaConfBaseException):  # a mistake, which the member will tell
        values = OmegaConf.to_container(OmegaConf.create(values), resolve=True)
    for name in without:
        _remove(values, name.split("."))
    text = json.dumps(values, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _remove(node: Any, path: Sequence[str]) -> None:
    *above, last = path
    for name in above:
        node = node.get(name, {})
    node.pop(last, None)


def _held(sweep: Path, job: Job) -> bool:
    try:
        with locked(sweep, lock_name(job)):
            return False
    except BusyError:
        return True


@contextmanager
def _exclusively(sweep: Path) -> Iterator[None]:
    """No other process changes the file meanwhile."""
    sweep.mkdir(parents=True, exist_ok=True)
    with open(sweep / ".members.lock", "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        for scratch in sweep.glob(f".{FILE}.*{PART}"):  # of a process that was killed
            shutil.rmtree(scratch)
        yield


def _load(sweep: Path) -> list[Job]:
    if not (sweep / FILE).is_file():
        return []
    try:
        rows = read_csv(sweep / FILE)
        if any(row.keys() != set(Job._fields) for row in rows):
            raise ValueError(f"its columns are not {','.join(Job._fields)}")
        if odd := [row["folder"] for row in rows if not row["folder"].isdecimal()]:
            raise ValueError(f"got the folder {odd[0]!r}, expected a number")
        return [Job(**row) for row in rows]
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(
            f"{sweep / FILE}: cannot be read ({error}); restore it, or give another folder with sweep_dir=…"
        ) from error


def _save(sweep: Path, jobs: Sequence[Job]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([Job._fields, *jobs])
    write_text(sweep / FILE, text.getvalue())
