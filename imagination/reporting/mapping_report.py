"""The written report of an evaluation: its tables as files, and beside them what a reader must know about them."""

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
"""In tables/: where the numbers come from."""


class Provenance(NamedTuple):
    """Where a report's numbers come from.

    Attributes:
        command: that made them.
        seed: of the run that trained.
        hardware: that it ran on.
        seconds: of wall time that evaluation took.
        sensor: what all approaches looked through, see `declared_sensor`.
    """

    command: str
    seed: int
    hardware: str
    seconds: float
    sensor: str


class Beside(NamedTuple):
    """Tables beside that of the maps.

    Attributes:
        training: what the networks were trained on and how well they do on single views.
        known: the same approaches in scenes with furniture as in training; None if there are none.
    """

    training: Sequence[Row] = ()
    known: Report | None = None


def write_tables(
    folder: Path,
    report: Report,
    protocol: MappingProtocol,
    resolution: float,
    origin: Provenance,
    beside: Beside | None = None,
) -> None:
    """Write the tables into `folder`, each whole or not at all.

    These are mapping.csv, paired.csv, trials.csv, mapping.md and provenance.json, and where there is something to say
    training.csv and furniture.csv.
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
        *(_in_pairs(paired) if paired else []),
        *_beside(folder, report, protocol, beside or Beside()),
        "## How it was made",
        _circumstances(mapping, report, protocol, origin),
    ]
    write_text(folder / "mapping.md", "\n\n".join(parts) + "\n")


def declared_sensor(setting: Setting, approaches: Mapping[str, Approach]) -> str:
    """What decides how much a view can tell, for all approaches and for those that project segmentation."""
    camera, ego = setting.camera, setting.ego
    said = (
        f"{camera.width} x {camera.height} pixels, field of view {degrees(camera.field_of_view):.0f} degrees, "
        f"{camera.mount_height:g} m above the floor; egocentric map of {ego.cells * ego.resolution:.2f} m a side, "
        f"cells of {ego.resolution:g} m"
    )
    for name, approach in approaches.items():
        if isinstance(evidence := approach.evidence, ProjectedSegmentation):
            limit = "none but that map" if isinf(evidence.max_range) else f"{evidence.max_range:g} m"
            band = f"{evidence.low:g} to {evidence.high:g} m above the floor"
            said += f"; {name} projects returns {band}, range limit {limit}"
    return said


def _averages(report: Report, protocol: MappingProtocol) -> str:
    """What is averaged over what, and what is left out."""
    left_out = "; ".join(
        f"{category}: {len(names)} of {len(names) + len(report.scenes[category])}"
        for category, names in report.left_out.items()
    )
    sets = len(report.snap_distances)
    empty = sum(len(distances) == 0 for distances in report.snap_distances)
    views = sum(map(len, report.snap_distances)) * protocol.orientations
    return (
        f"A run is one scene, cell width and viewpoint set; each cell width has {protocol.viewpoint_sets} sets a scene, "
        f"with {protocol.orientations} random headings a viewpoint ({views} views in all). Truth is M_gt of the whole "
        "scene, seen or not. `iou_pooled` divides the correct pixels of all runs by the union's, `iou_mean` is the mean "
        f"of the runs' IoU, and pixels are summed over runs. The {CONFIDENCE:.0%} intervals of `iou_pooled` come from "
        f"{protocol.resamples} bootstrap resamples of scenes. Scenes without the category are left out ({left_out}). "
        f"{empty} of {sets} viewpoint sets are empty, the cell width being large for the scene, and count with "
        "empty maps."
    )


def _in_pairs(paired: list[Row]) -> list[str]:
    return [
        "## In pairs",
        to_markdown(paired, list(paired[0])),
        f"Differences of `iou_pooled`, with {CONFIDENCE:.0%} intervals over scenes resampled in pairs.",
    ]


def _beside(folder: Path, report: Report, protocol: MappingProtocol, beside: Beside) -> list[str]:
    """Write the tables beside that of the maps, and give their text."""
    parts = []
    if beside.training:
        write_text(folder / "training.csv", to_csv(beside.training))
        parts += [
            "## Networks",
            to_markdown(beside.training, list(beside.training[0])),
            "Rounds, samples, distinct views and minutes of training; the best IoU of single views on validation scenes "
            "(of a unit's egocentric maps, of a segmentation network's images), and of the latter on the images that "
            "are mapped here.",
        ]
    if beside.known is not None:
        rows = furniture_rows(report, beside.known, protocol)
        write_text(folder / "furniture.csv", to_csv(rows))
        parts += [
            "## Known and unseen furniture",
            to_markdown(rows, list(rows[0])),
            "`known`: scenes that were not trained on, with furniture drawn as training's; `unseen`: the test scenes.",
        ]
    return parts


def _circumstances(mapping: list[Row], report: Report, protocol: MappingProtocol, origin: Provenance) -> str:
    """Sensor, registration, choices, seed, hardware, time and command, as a list."""
    rules = ", ".join(f"{name} by {approach.rule}" for name, approach in protocol.approaches.items())
    order = max(abs(float(row["iou_pooled"]) - float(row["iou_shuffled"])) for row in mapping)
    distances = np.concatenate(report.snap_distances)
    moved = distances.mean() if len(distances) else 0.0
    postprocessing = {
        "none": "",
        "close": ", closed by {:g} m",
        "dilate": ", dilated by {:g} m",
        "ground_truth": " within the ground truth",
    }
    chosen = "; ".join(
        f"{name} ({category}) threshold {choice.threshold:.2f}"
        + postprocessing[protocol.approaches[name].postprocess].format(choice.kernel)
        for (name, category), choice in report.choices.items()
    )
    return "\n".join(
        [
            f"- Sensor, the same for all approaches: {origin.sensor}.",
            f"- Registration: {rules}; views in viewpoint order, then orientation. In a random order `iou_pooled` "
            f"changes by {order:.4f} at most. Viewpoints were moved {moved:.2f} m on average to free space.",
            f"- Chosen on validation scenes by pooled IoU at all cell widths together: {chosen}.",
            f"- Seed of the run {origin.seed}, of viewpoints, headings and bootstrap {protocol.seed}.",
            f"- {origin.hardware}; evaluation took {origin.seconds:.0f} s of wall time.",
            f"- Command: `{origin.command}`",
        ]
    )
