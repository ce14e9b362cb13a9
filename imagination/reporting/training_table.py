"""Table of the training of an evaluation's networks."""

from collections.abc import Sequence

from imagination.evaluation.records import Report
from imagination.models.segmentation.ade20k import SOURCE
from imagination.models.task_kind import TaskKind
from imagination.runs.checkpoint import Checkpoint
from imagination.utils.tabular import Row

COUNTED = "epochs", "samples", "views", "minutes", "until", "iou_val_views"
"""Columns that stay empty for a checkpoint without training statistics."""


def training_rows(checkpoints: Sequence[Checkpoint], report: Report, public: bool = False) -> list[Row]:
    """Return one row for each network and evaluated category.

    Args:
        checkpoints: checkpoints of the networks.
        report: results of the evaluation.
        public: whether public ADE20K weights segmented the images; their training is unknown.
    """
    rows = [
        {
            "network": str(checkpoint.config.name),
            "category": name,
            **_counted(checkpoint),
            "iou_first_person": f"{report.first_person[name]:.4f}" if _segments(checkpoint, report) else "",
        }
        for checkpoint in checkpoints
        for name in checkpoint.categories
        if name in report.scenes
    ]
    return rows + [
        {
            "network": SOURCE,
            "category": name,
            **dict.fromkeys(COUNTED, ""),
            "iou_first_person": f"{score:.4f}",
        }
        for name, score in report.first_person.items()
        if public
    ]


def _counted(checkpoint: Checkpoint) -> Row:
    """Return the training statistics of a checkpoint as cells."""
    stats = checkpoint.training_stats
    if not stats:
        return dict.fromkeys(COUNTED, "")
    return {
        "epochs": str(stats["epochs"]),
        "samples": str(stats["samples"]),
        "views": str(stats["views"]),
        "minutes": f"{stats['seconds'] / 60:.1f}",
        "until": "flat" if stats["flat"] else "last epoch",
        "iou_val_views": f"{stats['best']:.4f}",
    }


def _segments(checkpoint: Checkpoint, report: Report) -> bool:
    """Return whether a checkpoint segmented the images of the evaluation."""
    return checkpoint.kind is TaskKind.IMAGES and bool(report.first_person)
