"""Advisory file locks (flock), which end with the process that holds them."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


def lock(file: IO[str] | int, *, shared: bool = False, wait: bool = True) -> None:
    """Lock an open file until it is closed.

    Args:
        file: open file or file descriptor.
        shared: allow other shared locks at the same time; otherwise the lock is exclusive.
        wait: wait for other processes.

    Raises:
        BlockingIOError: if another process holds a conflicting lock and `wait` is false.
    """
    mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    fcntl.flock(file, mode if wait else mode | fcntl.LOCK_NB)


@contextmanager
def locked_file(path: Path, *, wait: bool = True) -> Iterator[IO[str]]:
    """Hold an exclusive lock on a file, which is created if it does not exist.

    Args:
        path: file to lock.
        wait: wait for other processes.

    Raises:
        BlockingIOError: if another process holds the lock and `wait` is false.
    """
    with open(path, "a") as file:
        lock(file, wait=wait)
        yield file
