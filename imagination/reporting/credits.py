"""Credits of the models and scans in the scenes of an evaluation: tables/credits.csv."""

from collections.abc import Sequence
from pathlib import Path

from imagination.scenes.source import Credit
from imagination.utils.atomic_io import write_text
from imagination.utils.tabular import csv_text


def write(folder: Path, credits: Sequence[Credit]) -> None:
    """Write credits.csv, unless there are no credits.

    Args:
        folder: folder tables/ of the results.
        credits: credits of the scene source.

    Raises:
        UserError: if the disk is full.
    """
    if credits:
        write_text(folder / "credits.csv", csv_text([Credit._fields, *credits]))
