"""Atomic writing of files: completely or not at all."""

import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from errno import EACCES, EDQUOT, EEXIST, EFBIG, EISDIR, ELOOP, ENAMETOOLONG, ENOSPC, ENOTDIR, EROFS
from pathlib import Path
from typing import Any

from imagination.utils.errors import CannotWriteError
from imagination.utils.file_lock import lock

PART = ".part"
"""Suffix of temporary folders."""

PART_NAME = re.compile(rf"\.(?P<target>.+)\.\w+{re.escape(PART)}")
"""Pattern of the names of temporary folders."""

STALE_SECONDS = 60.0
"""Age above which a temporary folder that no process holds was left by a process that was killed."""

BLOCKED = (ENOSPC, EDQUOT, EFBIG, EACCES, EROFS, ENOTDIR, EISDIR, EEXIST, ENAMETOOLONG, ELOOP)
"""Errors of a full or read-only disk, and of files or names in the way."""


@contextmanager
def replacing(path: Path, sync: bool = True) -> Iterator[Path]:
    """Replace `path` atomically with a temporary file or folder, but only if the context ends without an error.

    Args:
        path: path to replace.
        sync: wait until the content is on the disk; otherwise a crash of the machine may leave an empty file.

    Yields:
        temporary path in the same folder, to write to.

    Raises:
        CannotWriteError: if the disk is full or read-only.
    """
    with write_errors_reported(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with _scratch_folder(path) as scratch:
            temporary = scratch / path.name
            try:
                yield temporary
                if sync and temporary.is_file() and not temporary.is_symlink():
                    with open(temporary, "rb") as file:
                        os.fsync(file.fileno())
                os.replace(temporary, path)
            finally:
                temporary.unlink(missing_ok=True)
                scratch.rmdir()


@contextmanager
def write_errors_reported(path: Path) -> Iterator[None]:
    """Raise CannotWriteError, with the path and a remedy, if the disk is full or read-only or a file is in the way."""
    try:
        yield
    except OSError as error:
        if error.errno not in BLOCKED:
            raise
        raise CannotWriteError(
            f"could not write {path}: {error.strerror}; free some space or set paths.outputs and paths.cache to "
            "another disk; continue an interrupted run with resume=latest"
        ) from error


@contextmanager
def _scratch_folder(path: Path) -> Iterator[Path]:
    """Create a temporary folder next to `path` and hold a shared lock on it, which marks it as being written to."""
    while True:
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=PART, dir=path.parent))
        with suppress(FileNotFoundError):  # another process removed it before it was locked
            descriptor = os.open(scratch, os.O_RDONLY)
            try:
                lock(descriptor, shared=True)
                os.stat(scratch)
            except BaseException:
                os.close(descriptor)
                raise
            break
    try:
        yield scratch
    finally:
        os.close(descriptor)


def is_part(path: Path) -> bool:
    """Return whether a path is a temporary folder of `replacing`: no link, and with nothing in it but the target."""
    name = PART_NAME.fullmatch(path.name)
    if name is None or path.is_symlink() or not path.is_dir():
        return False
    return all(entry == name["target"] or is_part(path / entry) for entry in os.listdir(path))


def remove_stale_parts(paths: Iterable[Path]) -> None:
    """Remove temporary folders that were left by killed processes; those of running processes are kept.

    Args:
        paths: candidates; those that are no temporary folders are kept.
    """
    for scratch in paths:
        with suppress(OSError):  # removed or locked by another process, or not allowed
            if not is_part(scratch):
                continue
            descriptor = os.open(scratch, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                lock(descriptor, wait=False)
                # a new folder may not be locked yet
                if time.time() - os.fstat(descriptor).st_mtime > STALE_SECONDS:
                    shutil.rmtree(scratch)
            finally:
                os.close(descriptor)


def remove_parts(folder: Path) -> None:
    """Remove incomplete files of a killed process from a run folder, which the caller has locked."""
    for scratch in list(folder.rglob(f".*{PART}")):
        if is_part(scratch):
            shutil.rmtree(scratch)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text)


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write a compressed .npz file completely or not at all; equal arrays give equal bytes.

    Raises:
        CannotWriteError: if the disk is full or may not be written.
    """
    import numpy as np  # commands that only print their help do without

    with replacing(path) as temporary:
        np.savez_compressed(temporary, **arrays)
