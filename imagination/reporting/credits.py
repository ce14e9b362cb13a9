"""Credits of the models and scans that the scenes of an evaluation hold: tables/credits.csv."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from imagination.scenes.source import Credit
from imagination.utils.atomic_io import write_text


def write(folder: Path, credits: Sequence[Credit]) -> None:
    """Write credits.csv; nothing if there are no credits.

    Args:
        folder: tables/ of the results.
        credits: of the scene source.

    Raises:
        UserError: if the disk is full.
    """
    if credits:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([Credit._fields, *credits])
        write_text(folder / "credits.csv", text.getvalue())
