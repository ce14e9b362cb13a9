"""Logging of a run to the screen and to a file in its folder."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rich.logging import RichHandler

from imagination.utils.progress import console

FILE_ONLY = {"file_only": True}
"""Value of `extra` for a message that is written to the log file only."""


class _LogFile(logging.FileHandler):
    """Log file that ignores write errors: a full disk is reported once, by the writer of the run's results."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)

    def close(self) -> None:
        with suppress(OSError):
            super().close()


@contextmanager
def logging_to(file: Path) -> Iterator[None]:
    """Log messages to the screen and, with their time, to a file."""
    screen = RichHandler(console=console, show_path=False, show_time=False, show_level=False)
    if not console.is_terminal:  # output to a file or program: lines are not wrapped
        screen = logging.StreamHandler()  # type: ignore[assignment]
    screen.setFormatter(logging.Formatter("%(message)s"))
    screen.addFilter(lambda message: not hasattr(message, "file_only"))
    log_file = _LogFile(file)
    log_file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    previous = root.handlers[:], root.level
    root.handlers, root.level = [screen, log_file], logging.INFO
    logging.captureWarnings(True)
    try:
        yield
    finally:
        root.handlers, root.level = previous
        log_file.close()


def quiet_lightning() -> None:
    """Silence Lightning's info messages except requested reports, and its warnings that do not apply here."""
    logging.getLogger("lightning").handlers.clear()  # the messages reach the handlers of the run
    for name in ("lightning.pytorch", "lightning.fabric.utilities.distributed"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for name in ("lightning.pytorch.profilers", "lightning.pytorch.callbacks.model_summary"):
        logging.getLogger(name).setLevel(logging.INFO)
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"lightning\.")
    # expected when a run resumes
    warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")
    # srun is not supported, see check_processes
    warnings.filterwarnings("ignore", message="The `srun` command is available")
    # the data loader yields complete batches
    warnings.filterwarnings("ignore", message=".*does not have many workers")
    warnings.filterwarnings("ignore", message=".*sync_dist=True.*")  # logged values are equal on all ranks
