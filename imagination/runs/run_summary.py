"""What a run tells at its end: scores of single views, where the time went, where everything lies."""

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
from imagination.utils.timing import shares

if TYPE_CHECKING:
    from lightning import Trainer

REGIONS = {"all": "", "seen": "_seen", "unseen": "_unseen"}
"""Cells of the egocentric map, and the ending of their scores' names."""

SETTINGS = ("name", "seed", "unit_categories", "scale", "kernels", "aggregation_factor", "model", "mapping")
"""Nodes of the config that TensorBoard shows as hyperparameters."""


def record_hyperparameters(trainer: Trainer, config: DictConfig) -> None:
    """Show the run's settings beside its final figures in TensorBoard's HParams tab."""
    from lightning.pytorch.loggers import TensorBoardLogger
    from torch.utils.tensorboard import SummaryWriter
    from torch.utils.tensorboard.summary import hparams

    figures = {
        name: float(value)
        for name, value in trainer.callback_metrics.items()
        if name.startswith(("test/", "global/"))
    }
    for logger in trainer.loggers:
        # its own log_hyperparams would log the figures a second time
        if isinstance(logger, TensorBoardLogger):
            with SummaryWriter(logger.log_dir) as writer:
                for part in hparams(settings(config), figures):  # type: ignore[no-untyped-call]
                    writer.file_writer.add_summary(part)


def settings(config: DictConfig) -> dict[str, Any]:
    """What TensorBoard shows of a config: values, and the class of what a node builds."""
    values: Any = OmegaConf.to_container(config, resolve=True)
    shown = leaves({node: values[node] for node in SETTINGS})
    return {key: str(value) if isinstance(value, list) else value for key, value in shown}


def single_views(run: Run, trainer: Trainer) -> str:
    """Write the scores of single views of test scenes, and tell them with what was trained on.

    A unit's are those of its egocentric maps, tables/ego.csv; a segmentation network's those of its images,
    tables/first_person.csv.
    """
    scores = {name: float(value) for name, value in trainer.callback_metrics.items()}
    if "test/iou_seen" in scores:
        what, file, header, parts = "Egocentric", "ego", "cells", REGIONS
        told = ", ".join(
            f"{scores[f'test/iou{ending}']:.3f} over {cells} cells" for cells, ending in parts.items()
        )
    else:
        what, file, header = "First-person", "first_person", "category"
        parts = {"mean": ""} | {name: f"_{name}" for name in run.config.unit_categories}
        told = ", ".join(f"{name} {scores[f'test/iou{ending}']:.3f}" for name, ending in parts.items())
    lines = [f"{header},iou,precision,recall"]
    for name, ending in parts.items():
        values = (f"{scores[f'test/{of}{ending}']:.4f}" for of in ("iou", "precision", "recall"))
        lines.append(",".join([name, *values]))
    write_text(run.folder / "tables" / f"{file}.csv", "\n".join(lines) + "\n")
    told = f"{what} IoU on views of unseen scenes: {told} (tables/{file}.csv)"
    if "data/collected_views" in scores:  # not when a finished run is only tested again
        views, draws = scores["data/collected_views"], scores["data/draws_per_view"]
        told += f"\nTrained on {views * draws:.0f} samples of {views:.0f} distinct views, {draws:.1f} draws a view"
    return told


def summary(run: Run, checkpoint: Path | None) -> str:
    """Where the time went, the memory taken, where everything lies and what to do with it."""
    seconds = shares.report()
    parts = ", ".join(
        f"{name} {value:.0f} s ({value / seconds['total']:.0%})" for name, value in seconds.items()
    )
    lines = [f"Time: {parts}", f"Peak memory: at most {peak_memory(run.config.scale.workers):.1f} GB"]
    lines.append(f"Results: {run.folder}/ (tables/, figures/, maps/, checkpoints/, tensorboard/)")
    kept = checkpoint or run.folder / LAST
    if kept.is_file():
        lines.append(f"Evaluate again: python -m imagination.evaluate ckpt={kept}")
    return "\n".join(lines)


def peak_memory(workers: int) -> float:
    """Upper bound of the memory in use at once, GB: this process's peak and, for each worker, the largest one's."""
    unit = 1e9 if sys.platform == "darwin" else 1e6  # bytes there, kilobytes on Linux
    own, largest = (
        resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return (own + workers * largest) / unit
