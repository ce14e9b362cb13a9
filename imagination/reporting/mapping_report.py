"""Files of an evaluation's tables (CSV, Markdown) with their explanations and provenance, made from its records."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from imagination.evaluation.metrics import CONFIDENCE
from imagination.reporting import tables
from imagination.reporting.load_run import Results
from imagination.reporting.statistics import MIN_SCENES
from imagination.utils.tabular import Row, markdown_code, markdown_text, to_csv, to_markdown

POSTPROCESSING = {
    "none": "",
    "close": ", closed by {:g} m",
    "dilate": ", dilated by {:g} m",
    "ground_truth": " within the ground truth",
}
"""Descriptions of the operations on maps; see `Approach`."""


def table_files(results: Results) -> dict[str, str]:
    """Return the contents of the tables of an evaluation by file name.

    These are mapping.csv, mapping_seeds.csv, mapping_details.csv, paired.csv and mapping.md; training.csv,
    furniture.csv and credits.csv if the records have data for them.

    Args:
        results: results with records.
    """
    rows = main_tables(results)
    frames = [tables.details(part.trials, part.about) for part in results.parts]
    rows["mapping_seeds"] = tables.text(tables.mapping_seeds(results.trials))
    rows["mapping_details"] = tables.text(pd.concat(frames))
    rows["training"] = [row for part in results.parts for row in _networks(part)]
    if len(results.known):
        rows["furniture"] = tables.text(tables.furniture(results.trials, results.known, results.bootstrap))
    rows["credits"] = results.about["credits"]
    files = {f"{name}.csv": to_csv(table) for name, table in rows.items() if table}
    return {**files, "mapping.md": to_page(rows, results)}


def main_tables(results: Results) -> dict[str, list[Row]]:
    """Return the rows of mapping.csv and paired.csv."""
    mapping = tables.mapping(results.trials, results.bootstrap)
    paired = tables.paired(results.trials, results.bootstrap)
    return {"mapping": tables.text(mapping), "paired": tables.text(paired, tables.SIGNED)}


def _networks(part: Results) -> list[Row]:
    """Return the rows of training.csv of one training seed."""
    rows = tables.networks(part.about["networks"], part.about["first_person"])
    return [{"network": row["network"], "seed": str(part.seed), **row} for row in rows]


def to_page(rows: Mapping[str, Sequence[Row]], results: Results) -> str:
    """Return mapping.md."""
    about = results.about
    parts = [
        "# Mapping from sparse viewpoints",
        to_markdown(rows["mapping"], tables.MAPPING),
        _averages(results),
    ]
    if rows["paired"]:
        parts += [
            "## Paired differences",
            to_markdown(rows["paired"], list(rows["paired"][0])),
            f"Differences of `iou_pooled`, with {CONFIDENCE:.0%} intervals over at least {MIN_SCENES} scenes (paired "
            "bootstrap).",
        ]
    if rows["training"]:
        parts += [
            "## Networks",
            to_markdown(rows["training"], list(rows["training"][0])),
            "Epochs, samples, distinct views and minutes of training; best IoU on single views of validation scenes "
            "(of egocentric maps for a unit, of images for a segmentation network); IoU of a segmentation network on "
            "the images of this evaluation.",
        ]
    if known := rows.get("furniture"):
        parts += [
            "## Known and unseen furniture",
            to_markdown(known, list(known[0])),
            "`known`: scenes with training furniture that were not trained on; `unseen`: the test scenes.",
        ]
    parts += ["## Provenance", _provenance(rows["mapping_details"], results, about)]
    return "\n\n".join(parts) + "\n"


def _averages(results: Results) -> str:
    """Explain the averages of the table and the scenes left out."""
    about, protocol = results.about, results.about["protocol"]
    left_out = "; ".join(
        f"{markdown_text(category)}: {count} of {count + about['scenes'].get(category, 0)}"
        for category, count in about["left_out"].items()
    )
    views = about["viewpoints"]["viewpoints"] * protocol["orientations"]
    seeds = (
        "" if len(results.seeds) == 1
        else "Values and pixels are means over training seeds, `iou_seed_std` is the standard deviation over seeds. "
    )  # fmt: skip
    return (
        f"A trial is one scene, cell width and viewpoint set; each cell width has {protocol['viewpoint_sets']} sets "
        f"per scene, with {protocol['orientations']} random headings per viewpoint ({views} views in all). The ground "
        "truth is M_gt of the whole scene, seen and unseen. `iou_pooled` divides the correct pixels of all trials by "
        "the pixels of the union, `iou_mean` is the mean IoU over trials, and pixels are summed over trials. "
        f"{seeds}The {CONFIDENCE:.0%} intervals of `iou_pooled` come from {results.bootstrap.resamples} bootstrap "
        f"resamples of scenes; fewer than {MIN_SCENES} scenes have no interval. Scenes without the category are left "
        f"out ({left_out}). {about['viewpoints']['empty']} of {about['viewpoints']['sets']} viewpoint sets are empty "
        "because the cell width is large for the scene, and count with empty maps."
    )


def _provenance(details: Sequence[Row], results: Results, about: Mapping[str, Any]) -> str:
    """List sensor, registration, selected thresholds, seeds, time and origin of the numbers."""
    rules = ", ".join(f"{name} by {each['rule']}" for name, each in about["approaches"].items())
    pooled = {
        (row["approach"], row["category"], row["cell_width"], row["seed"]): row["iou_pooled"]
        for row in tables.text(tables.mapping_seeds(results.trials))
    }
    order_effect = max(
        abs(
            float(row["iou_shuffled"])
            - float(pooled[row["approach"], row["category"], row["cell_width"], row["seed"]])
        )
        for row in details
    )
    seeds, origin = ", ".join(map(str, results.seeds)), results.provenance
    seconds = sum(part.about["seconds"] for part in results.parts)
    lines = [
        f"Sensor, the same for all approaches: {markdown_text(about['sensor'])}.",
        f"Registration: {markdown_text(rules)}; views in viewpoint order, then orientation. In a random order "
        f"`iou_pooled` changes by {order_effect:.4f} at most. Viewpoints were moved "
        f"{about['viewpoints']['moved']:.2f} m on average to free space.",
        f"Selected on validation scenes by IoU pooled over all cell widths: {_thresholds(results)}.",
        f"Seed of the training run {seeds}, of viewpoints, headings and bootstrap {about['protocol']['seed']}.",
        f"{markdown_text(origin.get('processor', ''))}, networks in {markdown_text(about['precision'])}; evaluation "
        f"took {seconds:.0f} s of wall time.",
        f"{markdown_text(origin.get('date', ''))}, imagination {markdown_text(origin.get('version', ''))}, commit "
        f"{markdown_text(origin.get('commit') or 'unknown')}.",
        f"Folder: {markdown_code(str(results.folder.resolve()))}",
        *(f"Command: {markdown_code(part.provenance.get('command', ''))}" for part in results.parts),
    ]
    return "\n".join(f"- {line}" for line in lines)


def _thresholds(results: Results) -> str:
    """Describe the selected thresholds and kernels of one training seed."""
    if len(results.seeds) > 1:
        return "mapping_details.csv lists threshold and kernel of each training seed"
    about = results.about
    return "; ".join(
        markdown_text(f"{each['approach']} ({each['category']}) threshold {each['threshold']:.2f}")
        + POSTPROCESSING.get(about["approaches"][each["approach"]]["postprocess"], "").format(each["kernel"])
        for each in about["selected"]
        if each["approach"] in about["approaches"]
    )
