"""Run folders: created exclusively, and the `latest` link."""

import shutil
import time
from datetime import datetime
from itertools import count
from pathlib import Path

from imagination.utils.atomic_io import PART, replacing, write_errors_reported
from imagination.utils.errors import UserError

CONFIG = "config.yaml"
"""The resolved config, for people and tables."""

COMPOSED = "composed.yaml"
"""The same with its references, from which a run goes on (its folder may have moved since)."""

LAST = Path("checkpoints") / "last.ckpt"
BEST = Path("checkpoints") / "best.ckpt"

STAMP = "%Y-%m-%d_%H-%M-%S"


def create_folder(parent: Path, name: str) -> Path:
    """Make a new folder that nobody else has: parent/name, or with _1, _2 … where that exists."""
    with write_errors_reported(parent):
        parent.mkdir(parents=True, exist_ok=True)
        for number in count():
            folder = parent / (f"{name}_{number}" if number else name)
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    raise AssertionError("unreachable: count() has no end")


def point_latest(folder: Path) -> str | None:
    """Let `latest` beside a run folder point to it, in one step; the name of the folder it pointed to before."""
    link = folder.parent / "latest"
    before = link.readlink().name if link.is_symlink() else None
    for scratch in link.parent.glob(
        f".{link.name}.*{PART}"
    ):  # a process was killed in the moment that this takes
        if time.time() - scratch.lstat().st_mtime > 60:
            shutil.rmtree(scratch, ignore_errors=True)
    with replacing(link) as temporary:
        temporary.symlink_to(folder.name)
    return before


def take_back_latest(folder: Path, before: str | None) -> None:
    """Let `latest` point to where it did before, unless another run has taken it since."""
    link = folder.parent / "latest"
    if not link.is_symlink() or link.readlink().name != folder.name:
        return
    if before is None:
        link.unlink()
    else:
        point_latest(folder.parent / before)


def find_latest(outputs: Path, name: str | None) -> Path:
    """The newest run folder of an experiment, or of all of them.

    Raises:
        UserError: if there is none.
    """
    links = sorted(outputs.glob(f"{name or '*'}/latest"))
    folders = [link.resolve() for link in links if (link / COMPOSED).is_file()]
    if not folders:
        wanted = f"the experiment {name!r}" if name else "any experiment"
        raise UserError(
            f"resume=latest: found no run of {wanted} in {outputs.resolve()}; start one without resume"
        )
    return within(max(folders, key=lambda folder: (folder.name, folder.parent.name)))


def within(folder: Path) -> Path:
    """A folder without symbolic links, told from the current directory if it lies in it."""
    folder, here = folder.resolve(), Path.cwd().resolve()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder


def now() -> str:
    """The time as run folders carry it."""
    return datetime.now().strftime(STAMP)
