"""Files written completely or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from errno import EACCES, EDQUOT, EFBIG, ENOSPC, EROFS
from pathlib import Path

from imagination.utils.errors import CannotWriteError

PART = ".part"
"""Ending of temporary names."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`; what is written there takes `path`'s place at the end, on an error nothing does.

    Raises:
        CannotWriteError: if the disk is full or may not be written.
    """
    with write_errors_reported(path):
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
def write_errors_reported(path: Path) -> Iterator[None]:
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
