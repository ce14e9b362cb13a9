"""Rows of the tables of the mapping task, and tables for the terminal."""

from collections.abc import Sequence
from itertools import product

from rich.table import Table

from imagination.evaluation.approaches import REFERENCE
from imagination.evaluation.metrics import bootstrap_iou, interval, iou, mean_iou, pooled_iou, resample
from imagination.evaluation.protocol import MappingProtocol
from imagination.evaluation.records import Report
from imagination.utils.tabular import Row

PIXELS = "correct_pixels", "false_positives", "gt_pixels"
"""Columns of the three counts."""

MAIN = (
    "approach",
    "category",
    "cell_width",
    "trials",
    "iou_pooled",
    "iou_mean",
    "iou_ci_low",
    "iou_ci_high",
    *PIXELS,
)
"""First columns of mapping.csv, and the columns in mapping.md."""

SCREEN_MAPPING = (
    "approach", "category", "cell_width", "iou_pooled", "iou_ci_low", "iou_ci_high", *PIXELS,
)  # fmt: skip
"""Columns of the results table in the terminal."""

SCREEN_PAIRED = "difference", "category", "cell_width", "iou_pooled", "ci_low", "ci_high", "correct_pixels"
"""Columns of the table of paired differences in the terminal."""


def mapping_rows(report: Report, protocol: MappingProtocol, resolution: float) -> list[Row]:
    """Return one row for each approach, category and cell width."""
    rows = []
    for key, counts in report.counts.items():
        low, high = interval(bootstrap_iou(counts, resample(len(counts), protocol.resamples, protocol.seed)))
        correct, false, gt = counts.sum(axis=(0, 1)).tolist()
        selected = report.selected[key.approach, key.category]
        rows.append(
            {
                "approach": key.approach,
                "category": key.category,
                "cell_width": f"{key.cell_width:g}",
                "trials": str(counts.shape[0] * counts.shape[1]),
                "iou_pooled": f"{pooled_iou(counts):.4f}",
                "iou_mean": f"{mean_iou(counts):.4f}",
                "iou_ci_low": f"{low:.4f}",
                "iou_ci_high": f"{high:.4f}",
                "correct_pixels": str(correct),
                "false_positives": str(false),
                "gt_pixels": str(gt),
                "area_m2": f"{correct * resolution**2:.4f}",
                "resolution": f"{resolution:g}",
                "scenes": str(counts.shape[0]),
                "scenes_left_out": str(len(report.left_out[key.category])),
                "threshold": f"{selected.threshold:.2f}",
                "kernel_m": f"{selected.kernel:g}",
                "iou_shuffled": f"{pooled_iou(report.shuffled[key]):.4f}",
                "iou_seen": f"{pooled_iou(report.seen[key]):.4f}",
                "iou_unseen": f"{pooled_iou(counts - report.seen[key]):.4f}",
                "iou_val": f"{selected.iou:.4f}",
            }
        )
    return rows


def pairs(approaches: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of approaches that are compared: `REFERENCE` with each other one."""
    return [(REFERENCE, name) for name in approaches if name != REFERENCE and REFERENCE in approaches]


def paired_rows(report: Report, protocol: MappingProtocol) -> list[Row]:
    """Return paired differences of pooled IoU between approaches, with bootstrap intervals over scenes."""
    rows = []
    compared = pairs(list(dict.fromkeys(key.approach for key in report.counts)))
    for (first, second), (key, counts) in product(compared, report.counts.items()):
        if key.approach != second:
            continue
        ours = report.counts[key._replace(approach=first)]
        draws = resample(len(counts), protocol.resamples, protocol.seed)
        low, high = interval(bootstrap_iou(ours, draws) - bootstrap_iou(counts, draws))
        rows.append(
            {
                "category": key.category,
                "cell_width": f"{key.cell_width:g}",
                "difference": f"{first} - {second}",
                "iou_pooled": f"{pooled_iou(ours) - pooled_iou(counts):+.4f}",
                "ci_low": f"{low:+.4f}",
                "ci_high": f"{high:+.4f}",
                "correct_pixels": f"{int(ours[..., 0].sum() - counts[..., 0].sum()):+d}",
                "scenes": str(len(counts)),
            }
        )
    return rows


def trial_rows(report: Report) -> list[Row]:
    """Return the counts of every trial, from which all tables are computed."""
    return [
        {
            "approach": key.approach,
            "category": key.category,
            "cell_width": f"{key.cell_width:g}",
            "scene": scene,
            "viewpoint_set": str(number),
            "iou": f"{float(iou(counts[place, number])):.4f}",
            **dict(zip(PIXELS, map(str, counts[place, number].tolist()), strict=True)),
        }
        for key, counts in report.counts.items()
        for place, scene in enumerate(report.scenes[key.category])
        for number in range(counts.shape[1])
    ]


def furniture_rows(unseen: Report, known: Report, protocol: MappingProtocol) -> list[Row]:
    """Return pooled IoU with intervals in scenes with training furniture (not trained on) and in test scenes."""
    rows = []
    for key, counts in known.counts.items():
        row = {"approach": key.approach, "category": key.category, "cell_width": f"{key.cell_width:g}"}
        for name, part in (("known", counts), ("unseen", unseen.counts[key])):
            draws = resample(len(part), protocol.resamples, protocol.seed)
            low, high = interval(bootstrap_iou(part, draws))
            row |= {
                f"iou_{name}": f"{pooled_iou(part):.4f}",
                f"ci_low_{name}": f"{low:.4f}",
                f"ci_high_{name}": f"{high:.4f}",
                f"scenes_{name}": str(len(part)),
            }
        rows.append(row)
    return rows


def to_screen(rows: Sequence[Row], title: str, columns: Sequence[str]) -> Table:
    """Return some columns of a table as a narrow table for the terminal."""
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    for column in columns:
        left = column in ("approach", "category", "difference")
        wrap = column == "difference"  # contains two long names
        table.add_column(column.replace("_", "\n"), justify="left" if left else "right", no_wrap=not wrap)
    for row in rows:
        table.add_row(*(row[column] for column in columns))
    return table
