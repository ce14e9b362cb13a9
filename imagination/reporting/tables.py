"""The rows of the mapping task's tables, and tables as CSV, as Markdown and on the screen."""

from collections.abc import Sequence
from itertools import product

from rich.table import Table

from imagination.evaluation.approaches import REFERENCE
from imagination.evaluation.metrics import bootstrap_iou, interval, iou, mean_iou, pooled_iou, resample
from imagination.evaluation.protocol import MappingProtocol
from imagination.evaluation.records import Report
from imagination.utils.tabular import Row

PIXELS = "correct_pixels", "false_positives", "gt_pixels"

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
"""The first columns of mapping.csv, which mapping.md shows."""

SCREEN_MAPPING = (
    "approach", "category", "cell_width", "iou_pooled", "iou_ci_low", "iou_ci_high", *PIXELS,
)  # fmt: skip
SCREEN_PAIRED = "difference", "category", "cell_width", "iou_pooled", "ci_low", "ci_high", "correct_pixels"
"""Columns of the tables on the screen."""


def mapping_rows(report: Report, protocol: MappingProtocol, resolution: float) -> list[Row]:
    """One row for each approach, category and cell width."""
    rows = []
    for key, counts in report.counts.items():
        low, high = interval(bootstrap_iou(counts, resample(len(counts), protocol.resamples, protocol.seed)))
        correct, false, truth = counts.sum(axis=(0, 1)).tolist()
        choice = report.choices[key.approach, key.category]
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
                "gt_pixels": str(truth),
                "area_m2": f"{correct * resolution**2:.4f}",
                "resolution": f"{resolution:g}",
                "scenes": str(counts.shape[0]),
                "scenes_left_out": str(len(report.left_out[key.category])),
                "threshold": f"{choice.threshold:.2f}",
                "kernel_m": f"{choice.kernel:g}",
                "iou_shuffled": f"{pooled_iou(report.shuffled[key]):.4f}",
                "iou_seen": f"{pooled_iou(report.seen[key]):.4f}",
                "iou_unseen": f"{pooled_iou(counts - report.seen[key]):.4f}",
                "iou_val": f"{choice.iou:.4f}",
            }
        )
    return rows


def pairs(approaches: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of approaches that are compared: `REFERENCE` with each other one."""
    return [(REFERENCE, name) for name in approaches if name != REFERENCE and REFERENCE in approaches]


def paired_rows(report: Report, protocol: MappingProtocol) -> list[Row]:
    """Differences of pooled IoU between approaches, resampled in pairs over scenes."""
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
    """The counts of every run, from which all tables follow."""
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
    """Pooled IoU in scenes with furniture as in training, none of them trained on, and in test scenes, with intervals."""
    rows = []
    for key, counts in known.counts.items():
        row = {"approach": key.approach, "category": key.category, "cell_width": f"{key.cell_width:g}"}
        for name, of_homes in (("known", counts), ("unseen", unseen.counts[key])):
            draws = resample(len(of_homes), protocol.resamples, protocol.seed)
            low, high = interval(bootstrap_iou(of_homes, draws))
            row |= {
                f"iou_{name}": f"{pooled_iou(of_homes):.4f}",
                f"ci_low_{name}": f"{low:.4f}",
                f"ci_high_{name}": f"{high:.4f}",
                f"homes_{name}": str(len(of_homes)),
            }
        rows.append(row)
    return rows


def to_screen(rows: Sequence[Row], title: str, columns: Sequence[str]) -> Table:
    """Some columns of a table, narrow enough for a terminal."""
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    for column in columns:
        left = column in ("approach", "category", "difference")
        wraps = column == "difference"  # of two long names
        table.add_column(column.replace("_", "\n"), justify="left" if left else "right", no_wrap=not wraps)
    for row in rows:
        table.add_row(*(row[column] for column in columns))
    return table
