"""Summary at the end of a run: scores of single views, time per stage, peak memory and paths of the results."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from imagination.config.overrides import leaves
from imagination.runs.folder import LAST
from imagination.runs.resume import Run
from imagination.utils.atomic_io import write_text
from imagination.utils.timing import stage_timer

if TYPE_CHECKING:
    from lightning import Trainer

REGIONS = {"all": "", "seen": "_seen", "unseen": "_unseen"}
"""Suffix of the score names for each set of cells of the egocentric map."""

HYPERPARAMETERS = (
    *("name", "seed", "unit_categories", "data", "kernels", "aggregation_factor", "model", "mapping"),
)
"""Config nodes that TensorBoard shows as hyperparameters."""


def record_hyperparameters(trainer: Trainer, config: DictConfig) -> None:
    """Write the hyperparameters and final scores of a run for the HParams tab of TensorBoard."""
    from lightning.pytorch.loggers import TensorBoardLogger
    from torch.utils.tensorboard import SummaryWriter
    from torch.utils.tensorboard.summary import hparams

    scores = {
        name: float(value)
        for name, value in trainer.callback_metrics.items()
        if name.startswith(("test/", "global/"))
    }
    for logger in trainer.loggers:
        # TensorBoardLogger.log_hyperparams would log the scores a second time
        if isinstance(logger, TensorBoardLogger):
            with SummaryWriter(logger.log_dir) as writer:
                for event in hparams(hyperparameters(config), scores):  # type: ignore[no-untyped-call]
                    writer.file_writer.add_summary(event)


def hyperparameters(config: DictConfig) -> dict[str, Any]:
    """Return the hyperparameters by dotted key; a node with a `_target_` has the name of its class as the value."""
    values: Any = OmegaConf.to_container(config, resolve=True)
    items = leaves({node: values[node] for node in HYPERPARAMETERS})
    return {key: str(value) if isinstance(value, list) else value for key, value in items}


def write_single_view_scores(run: Run, trainer: Trainer) -> str:
    """Write the scores on single views of test scenes; return a message with the IoU and the number of samples.

    The scores of a unit (egocentric maps) are written to tables/ego.csv, those of a segmentation network (images) to
    tables/first_person.csv.
    """
    scores = {name: float(value) for name, value in trainer.callback_metrics.items()}
    if "test/iou_seen" in scores:
        kind, file, column, suffixes = "Egocentric", "ego", "cells", REGIONS
        ious = [f"{scores[f'test/iou{suffix}']:.3f} over {cells} cells" for cells, suffix in suffixes.items()]
    else:
        kind, file, column = "First-person", "first_person", "category"
        suffixes = {"mean": ""} | {name: f"_{name}" for name in run.config.unit_categories}
        ious = [f"{name} {scores[f'test/iou{suffix}']:.3f}" for name, suffix in suffixes.items()]
    lines = [f"{column},iou,precision,recall"]
    for name, suffix in suffixes.items():
        values = (f"{scores[f'test/{metric}{suffix}']:.4f}" for metric in ("iou", "precision", "recall"))
        lines.append(",".join([name, *values]))
    write_text(run.folder / "tables" / f"{file}.csv", "\n".join(lines) + "\n")
    message = f"{kind} IoU on views of test scenes: {', '.join(ious)} (tables/{file}.csv)"
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
    lines.append(f"Results: {run.folder}/ (tables/, figures/, maps/, checkpoints/, tensorboard/)")
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
