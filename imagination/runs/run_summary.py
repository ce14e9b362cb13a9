"""Summary at the end of a run: scores of single views, time per stage, peak memory and paths of the results."""

from __future__ import annotations

import resource
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from imagination.runs.folder import LAST
from imagination.runs.resume import Run
from imagination.utils.atomic_io import write_text
from imagination.utils.timing import stage_timer

if TYPE_CHECKING:
    from imagination.models.lit_task import LitTask


def write_single_view_scores(folder: Path, task: LitTask, scores: Mapping[str, float]) -> str:
    """Write the scores on single views of test scenes; return a message with the IoU and the number of samples.

    The scores of a unit (egocentric maps) are written to tables/ego.csv, those of a segmentation network (images) to
    tables/first_person.csv.

    Args:
        folder: run folder.
        task: trained task.
        scores: last logged values of the run by name.
    """
    table = task.score_table
    lines = [f"{table.column},iou,precision,recall"]
    for name, suffix in table.suffixes.items():
        values = (f"{scores[f'test/{metric}{suffix}']:.4f}" for metric in ("iou", "precision", "recall"))
        lines.append(",".join([name, *values]))
    write_text(folder / "tables" / f"{table.name}.csv", "\n".join(lines) + "\n")
    ious = ", ".join(f"{name} {scores[f'test/iou{suffix}']:.3f}" for name, suffix in table.suffixes.items())
    message = f"{table.title} IoU on views of test scenes by {table.column}: {ious} (tables/{table.name}.csv)"
    if "data/collected_views" in scores:  # missing if a finished run is only tested again
        views, draws = scores["data/collected_views"], scores["data/draws_per_view"]
        message += f"\nTrained on {views * draws:.0f} samples of {views:.0f} distinct views, {draws:.1f} draws per view"
    return message


def summary(run: Run, checkpoint: Path | None) -> str:
    """Return a message with the time per stage, the peak memory, the results folder and the evaluation command."""
    seconds = stage_timer.report()
    parts = ", ".join(
        f"{name} {value:.0f} s ({value / seconds['total']:.0%})" for name, value in seconds.items()
    )
    lines = [f"Time: {parts}", f"Peak memory: at most {peak_memory(run.config.data.workers):.1f} GB"]
    folders = ", ".join(f"{path.name}/" for path in sorted(run.folder.iterdir()) if path.is_dir())
    lines.append(f"Results: {run.folder}/ ({folders})")
    checkpoint = checkpoint or run.folder / LAST
    if checkpoint.is_file():
        lines.append(f"Evaluate again: python -m imagination.evaluate ckpt={checkpoint}")
    return "\n".join(lines)


def peak_memory(workers: int) -> float:
    """Return an upper bound of the peak memory of this process and its workers, GB; workers count as the largest."""
    unit = 1e9 if sys.platform == "darwin" else 1e6  # ru_maxrss: bytes on macOS, kilobytes on Linux
    process, worker = (
        resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return (process + workers * worker) / unit
