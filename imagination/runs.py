"""Run folders: made exclusively, locked while in use, each file written whole or not at all."""

import fcntl
import logging
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from errno import EACCES, EDQUOT, EFBIG, ENOSPC, EROFS
from itertools import count
from pathlib import Path

from rich.logging import RichHandler

from imagination.errors import CannotWriteError, UserError
from imagination.progress import console

CONFIG = "config.yaml"
"""The resolved config, for people and tables."""

COMPOSED = "composed.yaml"
"""The same with its references, from which a run goes on (its folder may have moved since)."""

LAST = Path("checkpoints") / "last.ckpt"
BEST = Path("checkpoints") / "best.ckpt"

FILE_ONLY = {"file_only": True}
"""`extra` of a message for the log file alone."""

PART = ".part"
"""Ending of temporary names."""

STAMP = "%Y-%m-%d_%H-%M-%S"


def check_name(name: str) -> str:
    """Return the name of an experiment if it can be a folder's.

    Raises:
        UserError: if it cannot, or is one that the program uses itself.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.+-]*", name) or name in ("default", "cache", "latest"):
        raise UserError(
            f"name: got {name!r}, expected letters, digits and _ . + - (and not default, cache or latest)"
        )
    return name


def create_folder(parent: Path, name: str) -> Path:
    """Make a new folder that nobody else has: parent/name, or with _1, _2 … where that exists."""
    with write_errors_told(parent):
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


class BusyError(UserError):
    """Another process holds a lock."""


@contextmanager
def locked(folder: Path, name: str = ".lock") -> Iterator[None]:
    """Hold a run folder, by a file in it; the lock goes with the process, however it ends.

    Raises:
        BusyError: if another process holds it.
    """
    with open(folder / name, "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BusyError(
                f"run {folder}: another process is working on it; wait for it or stop it"
            ) from error
        yield


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`; what is written there takes `path`'s place at the end, on an error nothing does.

    Raises:
        CannotWriteError: if the disk is full or may not be written.
    """
    with write_errors_told(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=PART, dir=path.parent))
        temporary = scratch / path.name
        try:
            yield temporary
            if temporary.is_file() and not temporary.is_symlink():
                with open(temporary, "rb") as file:
                    os.fsync(file.fileno())  # else a crash of the machine may leave an empty file
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
            scratch.rmdir()


@contextmanager
def write_errors_told(path: Path) -> Iterator[None]:
    """Turn a full disk or a folder that may not be written into an error that says where and what to do."""
    try:
        yield
    except OSError as error:
        if error.errno not in (ENOSPC, EDQUOT, EFBIG, EACCES, EROFS):
            raise
        raise CannotWriteError(
            f"could not write {path}: {error.strerror}; free some space or set paths.outputs and paths.cache to "
            "another place; a run that was under way goes on with resume=latest"
        ) from error


def remove_parts(folder: Path) -> None:
    """Remove what a killed process left half-written in a run folder, which the caller holds."""
    for scratch in list(folder.rglob(f".*{PART}")):
        shutil.rmtree(scratch)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text)


def now() -> str:
    """The time as run folders carry it."""
    return datetime.now().strftime(STAMP)


class _LogFile(logging.FileHandler):
    """A log that ends where the disk is full: what the work itself writes tells so, in one message."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)

    def close(self) -> None:
        with suppress(OSError):
            super().close()


@contextmanager
def logging_to(file: Path) -> Iterator[None]:
    """Send messages to the screen and, with their time, to a file."""
    screen = RichHandler(console=console, show_path=False, show_time=False, show_level=False)
    if not console.is_terminal:  # lines are for other programs then: never wrapped
        screen = logging.StreamHandler()  # type: ignore[assignment]
    screen.setFormatter(logging.Formatter("%(message)s"))
    screen.addFilter(lambda message: not hasattr(message, "file_only"))
    record = _LogFile(file)
    record.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    before = root.handlers[:], root.level
    root.handlers, root.level = [screen, record], logging.INFO
    logging.captureWarnings(True)
    try:
        yield
    finally:
        root.handlers, root.level = before
        record.close()
