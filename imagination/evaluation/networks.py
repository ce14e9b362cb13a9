"""Rows on the networks of an evaluation and their training."""

from collections.abc import Collection, Sequence

from imagination.models.segmentation.ade20k import SOURCE
from imagination.models.task_kind import TaskKind
from imagination.runs.checkpoint import Checkpoint
from imagination.utils.tabular import Row

COUNTED = "epochs", "samples", "views", "minutes", "until", "iou_val_views"
"""Columns that stay empty for a checkpoint without training statistics."""


def network_rows(
    checkpoints: Sequence[Checkpoint], categories: Collection[str], public: bool = False
) -> list[Row]:
    """Return one row for each network and evaluated category.

    Args:
        checkpoints: checkpoints of the networks.
        categories: evaluated categories.
        public: whether public ADE20K weights segment the images; their training is unknown.
    """
    rows = [
        {
            "network": str(checkpoint.config.name),
            "kind": str(checkpoint.kind),
            "category": name,
            **_counted(checkpoint),
        }
        for checkpoint in checkpoints
        for name in checkpoint.categories
        if name in categories
    ]
    unknown = dict.fromkeys(COUNTED, "")
    return rows + [
        {"network": SOURCE, "kind": str(TaskKind.IMAGES), "category": name, **unknown}
        for name in categories
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
