"""Signals that end a command: SIGINT (Ctrl-C) and SIGTERM (`kill`, `docker stop`, preemption by SLURM).

Both raise `Interrupted`, a KeyboardInterrupt, in the main thread. The command saves its results, prints how to
continue, and exits with code 130 or 143. A repeated signal does not disturb that, unless it takes too long.
"""

from __future__ import annotations

import atexit
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

log = logging.getLogger(__name__)

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a command."""

PATIENCE = 5.0
"""Time after the first signal in which further signals are ignored, seconds."""

CALLER = "IMAGINATION_CALLER"
"""Environment variable of a command that was started by another command, which prints how to continue."""


class Interrupted(KeyboardInterrupt):
    """Exception that a signal raises in the main thread."""


class _State:
    """State of this process.

    Attributes:
        signal: first signal that was received.
        since: time of the first signal, seconds.
        postponed: number of open `postponed` contexts.
        held: whether signals are held, see `hold`.
        reported: whether a message was printed.
    """

    signal: int | None = None
    since = 0.0
    postponed = 0
    held = False
    reported = False


def install() -> None:
    """Handle the signals in this process, except those that the parent process has set to be ignored (nohup)."""
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, _handle)
        atexit.register(_ignore)


def _ignore() -> None:
    """Ignore signals while the interpreter ends, which would otherwise replace the exit code of the command."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _handle(number: int, frame: FrameType | None) -> None:
    first = _State.signal is None
    if first:
        _State.signal, _State.since = number, time.monotonic()
    if first or time.monotonic() - _State.since > PATIENCE:
        check()


def interrupt(number: int) -> None:
    """End this process as the signal `number` does, because it ended a subprocess.

    Raises:
        Interrupted: always.
    """
    _State.signal = _State.signal or number
    raise Interrupted


def received() -> bool:
    """Return whether this process has received a signal."""
    return _State.signal is not None


def check() -> None:
    """Raise if a signal was received and not postponed; its exception may have been lost, e.g. in a destructor.

    Raises:
        Interrupted: if a signal was received.
    """
    if received() and not _State.postponed and not _State.held:
        raise Interrupted


def exit_code() -> int:
    """Return the exit code of an interrupted command: 130 for SIGINT, 143 for SIGTERM."""
    return 128 + (_State.signal or signal.SIGINT)


@contextmanager
def postponed() -> Iterator[None]:
    """Postpone signals to the end of the context, in which results are saved.

    Raises:
        Interrupted: at the end of the context, if the first signal was received in it.
    """
    before = received()
    _State.postponed += 1
    try:
        yield
    finally:
        _State.postponed -= 1
    if not before:
        check()


def hold() -> None:
    """Postpone signals until `release` is called."""
    _State.held = True


def release() -> None:
    """Handle signals again; `check` raises for one that was received since `hold`."""
    _State.held = False


def report(advice: str = "") -> None:
    """Report that the command was interrupted, once per process.

    Args:
        advice: how to continue.
    """
    if _State.reported:
        return
    _State.reported = True
    cause = "" if _State.signal in (None, signal.SIGINT) else f" by {signal.Signals(_State.signal).name}"
    extra = {"file_only": True} if CALLER in os.environ else None
    if extra is None or logging.getLogger().handlers:
        log.warning("Interrupted%s%s", cause, f". {advice}" if advice else "", extra=extra)


def react_at_once(react: Callable[[int], None]) -> None:
    """Call a function in a thread when a signal arrives, also while the main thread waits for another process.

    A signal handler runs in the main thread, and only after a collective operation has returned.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)

    def wait() -> None:
        while (number := os.read(reader, 1)[0]) not in SIGNALS:
            pass
        react(number)

    threading.Thread(target=wait, daemon=True).start()
