"""Run folders, each created exclusively, and the `latest` symlink."""

import os
import stat
from datetime import datetime
from itertools import count
from pathlib import Path

from imagination.utils.atomic_io import PART, remove_stale_parts, replacing, write_errors_reported
from imagination.utils.errors import UserError

CONFIG = "config.yaml"
"""File name of the resolved config, for readers and reports."""

COMPOSED = "composed.yaml"
"""File name of the config with its interpolations, from which a run resumes (its folder may have been moved)."""

LOG = "run.log"
"""File name of the messages of a run, to which a resumed run appends."""

LAST = Path("checkpoints") / "last.ckpt"
"""Path of the newest checkpoint in a run folder."""

BEST = Path("checkpoints") / "best.ckpt"
"""Path of the checkpoint with the best validation score in a run folder."""

TIMESTAMP = "%Y-%m-%d_%H-%M-%S"
"""Format of the time in names of run folders."""


def create_folder(parent: Path, name: str) -> Path:
    """Create a new folder parent/name, with the suffix _1, _2, … if the name exists, and return it."""
    with write_errors_reported(parent):
        parent.mkdir(parents=True, exist_ok=True)
        for number in count():
            folder = parent / (f"{name}_{number}" if number else name)
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    raise AssertionError("unreachable: count() is infinite")


def check_links(folder: Path) -> None:
    """Check that a folder holds only files and folders, and no links out of it, so that all is written inside.

    Raises:
        UserError: if there is a link to another place, or anything else, such as a FIFO, which would block.
    """
    root = os.path.realpath(folder)
    for parent, folders, files in os.walk(root):
        for path in (Path(parent) / name for name in (*folders, *files)):
            status = path.lstat()
            if stat.S_ISLNK(status.st_mode):
                inside = Path(os.path.realpath(path)).is_relative_to(root)
            elif stat.S_ISREG(status.st_mode):
                inside = path.name != LOG or status.st_nlink == 1
            else:
                inside = stat.S_ISDIR(status.st_mode)
            if not inside:
                raise UserError(
                    f"run {folder}: got {path}, which leads out of the folder or is no file, expected files and "
                    "folders; replace it by what it links to, or remove it"
                )


def point_latest(folder: Path) -> str | None:
    """Atomically update the `latest` symlink and return the name of its previous target."""
    link = folder.parent / "latest"
    previous = link.readlink().name if link.is_symlink() else None
    remove_stale_parts(link.parent.glob(f".{link.name}.*{PART}"))
    with replacing(link) as temporary:
        temporary.symlink_to(folder.name)
    return previous


def restore_latest(folder: Path, previous: str | None) -> None:
    """Reset the `latest` symlink to its previous target if it still points to `folder`."""
    link = folder.parent / "latest"
    if not link.is_symlink() or link.readlink().name != folder.name:
        return
    if previous is None:
        link.unlink()
    else:
        point_latest(folder.parent / previous)


def find_latest(outputs: Path, name: str | None) -> Path:
    """Return the newest run folder of an experiment, or of all experiments.

    Args:
        outputs: folder of all experiments.
        name: name of the experiment; all experiments if None.

    Raises:
        UserError: if there is no run folder.
    """
    links = sorted(outputs.glob(f"{name or '*'}/latest"))
    folders = [link.resolve() for link in links if (link / COMPOSED).is_file()]
    if not folders:
        experiment = f"the experiment {name!r}" if name else "any experiment"
        raise UserError(
            f"resume=latest: found no run of {experiment} in {outputs.resolve()}; start a run without resume"
        )
    return resolved_path(max(folders, key=lambda folder: (folder.name, folder.parent.name)))


def resolved_path(path: Path) -> Path:
    """Return a path without symlinks, relative to the current directory if the path is inside it."""
    path, current = path.resolve(), Path.cwd().resolve()
    return path.relative_to(current) if path.is_relative_to(current) else path


def timestamp() -> str:
    """Return the current time in the format of run folder names."""
    return datetime.now().strftime(TIMESTAMP)
