"""The tables of the mapping task: mapping.csv, paired.csv, mapping.md and the one on the screen."""

import csv
import io
from collections.abc import Mapping, Sequence
from math import degrees, isinf
from pathlib import Path
from typing import NamedTuple

from rich.box import SIMPLE_HEAD
from rich.table import Table

from imagination.evaluation.approaches import Approach, ProjectedSegmentation, Setting
from imagination.evaluation.metrics import (
    CONFIDENCE,
    bootstrap_iou,
    interval,
    iou,
    mean_iou,
    pooled_iou,
    resample,
)
from imagination.evaluation.protocol import MappingProtocol, Report
from imagination.runs import write_text

Row = dict[str, str]
"""Cells of a table's row by column, formatted, so that the same numbers give the same bytes."""

PIXELS = "correct_pixels", "false_pixels", "truth_pixels"

SCREEN_MAPPING = (
    "approach", "category", "cell_width", "iou_pooled", "iou_ci_low", "iou_ci_high", *PIXELS,
)  # fmt: skip
SCREEN_PAIRED = "difference", "category", "cell_width", "iou_pooled", "ci_low", "ci_high", "correct_pixels"
"""Columns of the tables on the screen."""

REFERENCE = "imagination"
"""The approach that the others are compared with in pairs."""


class Provenance(NamedTuple):
    """Where a table's numbers come from.

    Attributes:
        command: that made them.
        hardware: that it ran on.
        seconds: of wall time that evaluation took.
        sensor: what all approaches looked through, see `declared_sensor`.
    """

    command: str
    hardware: str
    seconds: float
    sensor: str


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
                "runs": str(counts.shape[0] * counts.shape[1]),
                "iou_pooled": f"{pooled_iou(counts):.4f}",
                "iou_mean": f"{mean_iou(counts):.4f}",
                "iou_ci_low": f"{low:.4f}",
                "iou_ci_high": f"{high:.4f}",
                "correct_pixels": str(correct),
                "false_pixels": str(false),
                "truth_pixels": str(truth),
                "area_m2": f"{correct * resolution**2:.4f}",
                "resolution": f"{resolution:g}",
                "homes": str(counts.shape[0]),
                "homes_left_out": str(len(report.left_out[key.category])),
                "threshold": f"{choice.threshold:.2f}",
                "kernel_m": f"{choice.kernel:g}",
                "iou_shuffled": f"{pooled_iou(report.shuffled[key]):.4f}",
            }
        )
    return rows


def paired_rows(report: Report, protocol: MappingProtocol) -> list[Row]:
    """Differences of pooled IoU between `REFERENCE` and each other approach, resampled in pairs over homes."""
    rows = []
    for key, counts in report.counts.items():
        reference = key._replace(approach=REFERENCE)
        if key == reference or reference not in report.counts:
            continue
        draws = resample(len(counts), protocol.resamples, protocol.seed)
        ours = report.counts[reference]
        low, high = interval(bootstrap_iou(ours, draws) - bootstrap_iou(counts, draws))
        rows.append(
            {
                "category": key.category,
                "cell_width": f"{key.cell_width:g}",
                "difference": f"{REFERENCE} - {key.approach}",
                "iou_pooled": f"{pooled_iou(ours) - pooled_iou(counts):+.4f}",
                "ci_low": f"{low:+.4f}",
                "ci_high": f"{high:+.4f}",
                "correct_pixels": f"{int(ours[..., 0].sum() - counts[..., 0].sum()):+d}",
                "homes": str(len(counts)),
            }
        )
    return rows


def run_rows(report: Report) -> list[Row]:
    """The counts of every run, from which all tables follow."""
    return [
        {
            "approach": key.approach,
            "category": key.category,
            "cell_width": f"{key.cell_width:g}",
            "home": home,
            "viewpoint_set": str(number),
            "iou": f"{float(iou(counts[place, number])):.4f}",
            **dict(zip(PIXELS, map(str, counts[place, number].tolist()), strict=True)),
        }
        for key, counts in report.counts.items()
        for place, home in enumerate(report.homes[key.category])
        for number in range(counts.shape[1])
    ]


def write(
    folder: Path, report: Report, protocol: MappingProtocol, resolution: float, origin: Provenance
) -> None:
    """Write mapping.csv, paired.csv, runs.csv and mapping.md into `folder`, each whole or not at all."""
    mapping, paired = mapping_rows(report, protocol, resolution), paired_rows(report, protocol)
    write_text(folder / "mapping.csv", to_csv(mapping))
    write_text(folder / "paired.csv", to_csv(paired))
    write_text(folder / "runs.csv", to_csv(run_rows(report)))
    write_text(folder / "mapping.md", to_markdown(mapping, paired, report, protocol, origin))


def to_csv(rows: Sequence[Row]) -> str:
    """Rows as comma-separated text with a header; empty without rows."""
    if not rows:
        return ""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def to_markdown(
    mapping: Sequence[Row],
    paired: Sequence[Row],
    report: Report,
    protocol: MappingProtocol,
    origin: Provenance,
) -> str:
    """The tables with everything that a reader needs to know about them."""
    left_out = "; ".join(
        f"{category}: {len(names)} of {len(names) + len(report.homes[category])}"
        for category, names in report.left_out.items()
    )
    order = max(abs(float(row["iou_pooled"]) - float(row["iou_shuffled"])) for row in mapping)
    percent = f"{CONFIDENCE:.0%}"
    views = len(report.snap_distance) * protocol.orientations
    parts = [
        "# Mapping from sparse viewpoints",
        _markdown_table(mapping, list(mapping[0])[:11]),
        f"""A run is one home, cell width and viewpoint set; each cell width has {protocol.viewpoint_sets} sets a home
and {protocol.orientations} random headings a viewpoint ({views} views in all). Truth is M_gt of the whole home, seen
or not. `iou_pooled` divides the correct pixels of all runs by the union's, `iou_mean` is the mean of the runs' IoU,
and pixels are summed over runs. The {percent} intervals of `iou_pooled` come from {protocol.resamples} bootstrap
resamples of homes. Homes without the category are left out ({left_out}).""",
        "## In pairs",
        _markdown_table(paired, list(paired[0])) if paired else f"There is no `{REFERENCE}` to compare with.",
        f"Differences of `iou_pooled`, with {percent} intervals over homes resampled in pairs.",
        "## How it was made",
        f"""- Sensor, the same for all approaches: {origin.sensor}.
- Registration: {_registered(protocol)}; views in viewpoint order, then orientation. In a random order `iou_pooled`
  changes by {order:.4f} at most. Viewpoints were moved {report.snap_distance.mean():.2f} m on average to free space.
- Chosen on validation homes by pooled IoU at all cell widths together: {_chosen(report, protocol)}.
- Seed {protocol.seed}; {origin.hardware}; evaluation took {origin.seconds:.0f} s of wall time.
- Command: `{origin.command}`""",
    ]
    return "\n\n".join(parts) + "\n"


def to_screen(rows: Sequence[Row], title: str, columns: Sequence[str]) -> Table:
    """Some columns of a table, narrow enough for a terminal."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1))
    for column in columns:
        left = column in ("approach", "category", "difference")
        table.add_column(column.replace("_", "\n"), justify="left" if left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(row[column] for column in columns))
    return table


def declared_sensor(setting: Setting, approaches: Mapping[str, Approach]) -> str:
    """What decides how much a view can tell, for all approaches and for those that project segmentation."""
    camera, ego = setting.camera, setting.ego
    extent = ego.cells * ego.resolution
    said = (
        f"{camera.width} x {camera.height} pixels, field of view {degrees(camera.field_of_view):.0f} degrees, "
        f"{camera.mount_height:g} m above the floor; egocentric map of {extent:.2f} m a side, cells of "
        f"{ego.resolution:g} m"
    )
    for name, approach in approaches.items():
        if isinstance(evidence := approach.evidence, ProjectedSegmentation):
            limit = "none but that map" if isinf(evidence.max_range) else f"{evidence.max_range:g} m"
            band = f"{evidence.low:g} to {evidence.high:g} m above the floor"
            said += f"; {name} projects returns {band}, range limit {limit}"
    return said


def _markdown_table(rows: Sequence[Mapping[str, str]], columns: Sequence[str]) -> str:
    lines = [columns, ["---"] * len(columns), *([row[column] for column in columns] for row in rows)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def _registered(protocol: MappingProtocol) -> str:
    return ", ".join(f"{name} by {approach.rule}" for name, approach in protocol.approaches.items())


def _chosen(report: Report, protocol: MappingProtocol) -> str:
    finished = {"keep": "", "close": ", closed by {:g} m", "grow": ", grown by {:g} m"}
    return "; ".join(
        f"{name} ({category}) threshold {choice.threshold:.2f}"
        + finished[protocol.approaches[name].finish].format(choice.kernel)
        for (name, category), choice in report.choices.items()
    )
