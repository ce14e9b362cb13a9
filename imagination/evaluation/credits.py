"""Whose models and scans the homes of an evaluation hold: tables/credits.csv."""

import csv
import io
from pathlib import Path

from imagination import runs
from imagination.scenes.scene import Credit, Credited, SceneSource


def write(folder: Path, source: SceneSource) -> None:
    """List everything that the source's homes may hold and others made; nothing if it names nobody.

    Args:
        folder: the run's tables/.
        source: of the homes.

    Raises:
        UserError: if the disk is full.
    """
    rows = source.credits() if isinstance(source, Credited) else ()
    if rows:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([Credit._fields, *rows])
        runs.write_text(folder / "credits.csv", text.getvalue())
