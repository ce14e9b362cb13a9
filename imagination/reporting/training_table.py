"""What the networks of an evaluation were trained on: the table beside that of the maps."""

from collections.abc import Sequence

from imagination.evaluation.records import Report
from imagination.models.segmentation.ade20k import SOURCE
from imagination.runs.checkpoint import Checkpoint
from imagination.utils.tabular import Row

COUNTED = "epochs", "samples", "views", "minutes", "until", "iou_val_views"
"""Columns that a checkpoint written without a record leaves empty."""


def training_rows(checkpoints: Sequence[Checkpoint], report: Report, public: bool = False) -> list[Row]:
    """One row for each network and category that is evaluated.

    Args:
        checkpoints: of the networks.
        report: of their evaluation.
        public: whether public weights for ADE20K segmented the images; what they took to train is not known here.
    """
    rows = [
        {
            "network": str(checkpoint.config.name),
            "category": name,
            **_counted(checkpoint),
            "iou_first_person": f"{report.first_person[name]:.4f}"
            if _maps_images(checkpoint, report)
            else "",
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
    record = checkpoint.record
    if not record:
        return dict.fromkeys(COUNTED, "")
    return {
        "epochs": str(record["epochs"]),
        "samples": str(record["samples"]),
        "views": str(record["views"]),
        "minutes": f"{record['seconds'] / 60:.1f}",
        "until": "flat" if record["flat"] else "last round",
        "iou_val_views": f"{record['best']:.4f}",
    }


def _maps_images(checkpoint: Checkpoint, report: Report) -> bool:
    return checkpoint.predicts == "images" and bool(report.first_person)
