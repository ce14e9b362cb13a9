"""What the networks of an evaluation were trained on: the table beside that of the maps."""

from collections.abc import Sequence

from imagination.checkpoints import KEY, Checkpoint
from imagination.evaluation.outcome import Report
from imagination.evaluation.tables import Row


def training_rows(checkpoints: Sequence[Checkpoint], report: Report) -> list[Row]:
    """One row for each checkpoint and category.

    Args:
        checkpoints: of the networks.
        report: of their evaluation.
    """
    rows = []
    for checkpoint in checkpoints:
        record, images = checkpoint.record, checkpoint.predicts == "images"
        counted = (
            {
                "rounds": f"{record['rounds']}",
                "samples": f"{record['samples']}",
                "views": f"{record['views']}",
                "minutes": f"{record['seconds'] / 60:.1f}",
                "iou_val_views": f"{record['best']:.4f}",
            }
            if record
            else dict.fromkeys(("rounds", "samples", "views", "minutes", "iou_val_views"), "")
        )
        rows += [
            {
                "network": str(checkpoint.state[KEY]["values"]["name"]),
                "category": name,
                "parameters": str(sum(tensor.numel() for tensor in checkpoint.state["state_dict"].values())),
                **counted,
                "iou_first_person": f"{report.first_person[name]:.4f}"
                if images and report.first_person
                else "",
            }
            for name in checkpoint.categories
            if name in report.homes
        ]
    return rows
