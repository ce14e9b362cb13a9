"""Files of an evaluation's tables (CSV, Markdown) with their explanations and provenance."""

import json
from collections.abc import Mapping, Sequence
from math import degrees, isinf
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imagination.evaluation.approaches import Approach, ProjectedSegmentation, Setting
from imagination.evaluation.metrics import CONFIDENCE
from imagination.evaluation.protocol import MappingProtocol
from imagination.evaluation.records import Report
from imagination.reporting.tables import MAIN, furniture_rows, mapping_rows, paired_rows, trial_rows
from imagination.utils.atomic_io import write_text
from imagination.utils.tabular import Row, to_csv, to_markdown

PROVENANCE = "provenance.json"
"""File in tables/ with the provenance of the numbers."""


class Provenance(NamedTuple):
    """Provenance of a report's numbers.

    Attributes:
        command: command of the evaluation.
        seed: seed of the training run.
        hardware: hardware and precision of the evaluation.
        seconds: wall time of the evaluation, seconds.
        sensor: description of the sensor by `declared_sensor`.
    """

    command: str
    seed: int
    hardware: str
    seconds: float
    sensor: str


class FurtherTables(NamedTuple):
    """Data of further tables.

    Attributes:
        training: rows on the training of the networks and their IoU on single views.
        known: results in scenes with training furniture; None if not evaluated.
    """

    training: Sequence[Row] = ()
    known: Report | None = None


def write_tables(
    folder: Path,
    report: Report,
    protocol: MappingProtocol,
    resolution: float,
    origin: Provenance,
    further: FurtherTables | None = None,
) -> None:
    """Write the tables into `folder`, each atomically.

    These are mapping.csv, paired.csv, trials.csv, mapping.md and provenance.json, and training.csv and furniture.csv if
    `further` has data for them.
    """
    mapping = mapping_rows(report, protocol, resolution)
    paired = paired_rows(report, protocol)
    write_text(folder / PROVENANCE, json.dumps(origin._asdict(), indent=1) + "\n")
    write_text(folder / "mapping.csv", to_csv(mapping))
    write_text(folder / "paired.csv", to_csv(paired))
    write_text(folder / "trials.csv", to_csv(trial_rows(report)))
    parts = [
        "# Mapping from sparse viewpoints",
        to_markdown(mapping, MAIN),
        _averages(report, protocol),
        *(_paired_differences(paired) if paired else []),
        *_write_further(folder, report, protocol, further or FurtherTables()),
        "## Provenance",
        _provenance(mapping, report, protocol, origin),
    ]
    write_text(folder / "mapping.md", "\n\n".join(parts) + "\n")


def declared_sensor(setting: Setting, approaches: Mapping[str, Approach]) -> str:
    """Describe the sensor and egocentric map of all approaches, and the limits of those that project segmentation."""
    camera, ego = setting.camera, setting.ego
    description = (
        f"{camera.width} x {camera.height} pixels, field of view {degrees(camera.field_of_view):.0f} degrees, "
        f"{camera.mount_height:g} m above the floor; egocentric map of {ego.cells * ego.resolution:.2f} m a side, "
        f"cells of {ego.resolution:g} m"
    )
    for name, approach in approaches.items():
        if isinstance(evidence := approach.evidence, ProjectedSegmentation):
            limit = "the egocentric map" if isinf(evidence.max_range) else f"{evidence.max_range:g} m"
            band = f"{evidence.low:g} to {evidence.high:g} m above the floor"
            description += f"; {name} projects returns {band}, range limit {limit}"
    return description


def _averages(report: Report, protocol: MappingProtocol) -> str:
    """Explain the averages of the table and the scenes left out."""
    left_out = "; ".join(
        f"{category}: {len(names)} of {len(names) + len(report.scenes[category])}"
        for category, names in report.left_out.items()
    )
    sets = len(report.snap_distances)
    empty = sum(len(distances) == 0 for distances in report.snap_distances)
    views = sum(map(len, report.snap_distances)) * protocol.orientations
    return (
        f"A trial is one scene, cell width and viewpoint set; each cell width has {protocol.viewpoint_sets} sets per "
        f"scene, with {protocol.orientations} random headings per viewpoint ({views} views in all). The ground truth "
        "is M_gt of the whole scene, seen and unseen. `iou_pooled` divides the correct pixels of all trials by the "
        "pixels of the union, `iou_mean` is the mean IoU over trials, and pixels are summed over trials. The "
        f"{CONFIDENCE:.0%} intervals of `iou_pooled` come from {protocol.resamples} bootstrap resamples of scenes. "
        f"Scenes without the category are left out ({left_out}). {empty} of {sets} viewpoint sets are empty because "
        "the cell width is large for the scene, and count with empty maps."
    )


def _paired_differences(paired: list[Row]) -> list[str]:
    """Return the section of paired differences."""
    return [
        "## Paired differences",
        to_markdown(paired, list(paired[0])),
        f"Differences of `iou_pooled`, with {CONFIDENCE:.0%} intervals over scenes (paired bootstrap).",
    ]


def _write_further(
    folder: Path, report: Report, protocol: MappingProtocol, further: FurtherTables
) -> list[str]:
    """Write the further tables and return their sections."""
    parts = []
    if further.training:
        write_text(folder / "training.csv", to_csv(further.training))
        parts += [
            "## Networks",
            to_markdown(further.training, list(further.training[0])),
            "Epochs, samples, distinct views and minutes of training; best IoU on single views of validation scenes "
            "(of egocentric maps for a unit, of images for a segmentation network); IoU of a segmentation network on "
            "the images of this evaluation.",
        ]
    if further.known is not None:
        rows = furniture_rows(report, further.known, protocol)
        write_text(folder / "furniture.csv", to_csv(rows))
        parts += [
            "## Known and unseen furniture",
            to_markdown(rows, list(rows[0])),
            "`known`: scenes with training furniture that were not trained on; `unseen`: the test scenes.",
        ]
    return parts


def _provenance(mapping: list[Row], report: Report, protocol: MappingProtocol, origin: Provenance) -> str:
    """List sensor, registration, selected thresholds, seed, hardware, time and command."""
    rules = ", ".join(f"{name} by {approach.rule}" for name, approach in protocol.approaches.items())
    order_effect = max(abs(float(row["iou_pooled"]) - float(row["iou_shuffled"])) for row in mapping)
    distances = np.concatenate(report.snap_distances)
    moved = distances.mean() if len(distances) else 0.0
    postprocessing = {
        "none": "",
        "close": ", closed by {:g} m",
        "dilate": ", dilated by {:g} m",
        "ground_truth": " within the ground truth",
    }
    thresholds = "; ".join(
        f"{name} ({category}) threshold {selected.threshold:.2f}"
        + postprocessing[protocol.approaches[name].postprocess].format(selected.kernel)
        for (name, category), selected in report.selected.items()
    )
    return "\n".join(
        [
            f"- Sensor, the same for all approaches: {origin.sensor}.",
            f"- Registration: {rules}; views in viewpoint order, then orientation. In a random order `iou_pooled` "
            f"changes by {order_effect:.4f} at most. Viewpoints were moved {moved:.2f} m on average to free space.",
            f"- Selected on validation scenes by IoU pooled over all cell widths: {thresholds}.",
            f"- Seed of the training run {origin.seed}, of viewpoints, headings and bootstrap {protocol.seed}.",
            f"- {origin.hardware}; evaluation took {origin.seconds:.0f} s of wall time.",
            f"- Command: `{origin.command}`",
        ]
    )
