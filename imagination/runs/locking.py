"""Locks on run folders."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from imagination.utils.errors import UserError


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
