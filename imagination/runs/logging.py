"""The log of a run, on the screen and in its folder."""

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
"""`extra` of a message for the log file alone."""


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


def quiet_lightning() -> None:
    """Leave out what Lightning tells about itself; its warnings stay."""
    for name in ("lightning.pytorch", "lightning.fabric.utilities.distributed"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"lightning\.")
    warnings.filterwarnings(
        "ignore", message="Checkpoint directory .* exists and is not empty"
    )  # as it should on resume
    # it is not to be used: see check_shares
    warnings.filterwarnings("ignore", message="The `srun` command is available")
    # batches are ready-made
    warnings.filterwarnings("ignore", message=".*does not have many workers")
    warnings.filterwarnings("ignore", message=".*sync_dist=True.*")  # these values are the same on all ranks
