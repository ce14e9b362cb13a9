"""Run folders: names of their files, exclusive creation, and the `latest` symlink."""

import os
import re
import stat
from contextlib import suppress
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


def best_checkpoint(folder: Path) -> Path | None:
    """Return the checkpoint with the best validation score in a run folder; None if there is no checkpoint."""
    return folder / BEST if (folder / BEST).is_file() else None


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


def point_latest(folder: Path, parent: Path | None = None) -> Path | None:
    """Atomically update the `latest` symlink and return its previous target.

    Args:
        folder: new target.
        parent: folder of the link; None: the parent of `folder`.
    """
    link = (parent or folder.parent) / "latest"
    previous = target_of(link)
    remove_stale_parts(link.parent.glob(f".{link.name}.*{PART}"))
    with replacing(link) as temporary:
        temporary.symlink_to(
            folder.name if folder.resolve().parent == link.parent.resolve() else folder.resolve()
        )
    return previous


def restore_latest(folder: Path, previous: Path | None, parent: Path | None = None) -> None:
    """Reset the `latest` symlink to its previous target if it still points to `folder`.

    Args:
        folder: folder of a run that was refused.
        previous: result of `point_latest`.
        parent: folder of the link; None: the parent of `folder`.
    """
    link = (parent or folder.parent) / "latest"
    target = target_of(link)
    if target is None or target.resolve() != folder.resolve():
        return
    if previous is None:
        link.unlink(missing_ok=True)
    else:
        point_latest(previous, link.parent)


def target_of(link: Path) -> Path | None:
    """Return the target of a symlink; None if there is no link, which other processes may remove at any time."""
    with suppress(OSError):
        return link.parent / os.readlink(link)
    return None


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
            f"resume=latest: found no run of {experiment} in {outputs.resolve()}; start a run without resume, or set "
            "resume=<run folder>"
        )
    return resolved_path(max(folders, key=lambda folder: (started(folder), folder.parent.name)))


def started(folder: Path) -> str:
    """Return the time at which a run was created, which its name contains unless the user has set `hydra.run.dir`."""
    if re.match(r"\d{4}-\d\d-\d\d", folder.name):
        return folder.name
    return datetime.fromtimestamp((folder / COMPOSED).stat().st_mtime).strftime(TIMESTAMP)


def resolved_path(path: Path) -> Path:
    """Return a path without symlinks, relative to the current directory if the path is inside it."""
    path, current = path.resolve(), Path.cwd().resolve()
    return path.relative_to(current) if path.is_relative_to(current) else path
