"""Locks on run folders."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from imagination.utils.errors import UserError
from imagination.utils.file_lock import lock


class BusyError(UserError):
    """Error raised if another process holds a lock."""


@contextmanager
def locked(folder: Path, name: str = ".lock") -> Iterator[None]:
    """Hold an exclusive lock on a run folder; the lock ends with the process.

    Args:
        folder: run folder.
        name: name of the lock file in the folder.

    Raises:
        BusyError: if another process holds the lock.
    """
    with open(folder / name, "a") as file:
        try:
            lock(file, wait=False)
        except BlockingIOError as error:
            raise BusyError(
                f"run {folder}: another process holds the lock of this folder; wait for that process or stop it"
            ) from error
        yield
