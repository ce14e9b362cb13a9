"""Final record of a run: final.json, written after all other results. A run without it is not finished."""

import json
from pathlib import Path
from typing import Any

from imagination.utils.atomic_io import write_text

FINAL = "final.json"
"""File name of the final record in a run folder."""


def write_final_record(folder: Path, **values: Any) -> None:
    """Mark a run as finished.

    Args:
        folder: run folder.
        values: results of the run, such as `score`.
    """
    write_text(folder / FINAL, json.dumps(values, indent=2) + "\n")


def read_final_record(folder: Path) -> dict[str, Any] | None:
    """Return the final record of a run, or None if the run is not finished."""
    try:
        values = json.loads((folder / FINAL).read_text())
    except (OSError, ValueError):  # missing or damaged
        return None
    return values if isinstance(values, dict) else None


def remove_final_record(folder: Path) -> None:
    """Mark a run as unfinished, because it continues."""
    (folder / FINAL).unlink(missing_ok=True)
