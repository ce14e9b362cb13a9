"""Tables and figures of a report made by hand."""

import csv
from io import StringIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from imagination.evaluation.records import Example, Key, Report
from imagination.evaluation.threshold_selection import SelectedThreshold
from imagination.evaluation.trials import Trial
from imagination.geometry.grid import Grid
from imagination.reporting.figures.maps import CORRECT, FALSE, MISSED, agreement_image
from imagination.reporting.figures.write import write_figures
from imagination.reporting.mapping_report import FurtherTables, Provenance, write_tables
from imagination.reporting.tables import SCREEN_MAPPING, SCREEN_PAIRED, mapping_rows, paired_rows, to_screen
from tests.helpers.toy_evaluation import make_protocol

COLUMNS = (
    "approach,category,cell_width,trials,iou_pooled,iou_mean,iou_ci_low,iou_ci_high,"
    "correct_pixels,false_positives,gt_pixels"
)
ORIGIN = Provenance(
    "python -m imagination.evaluate ckpt=x", 3, "a processor, 2 cores", 12.3, "128 x 128 pixels"
)


@pytest.fixture
def report() -> Report:
    rng = np.random.default_rng(0)
    protocol = make_protocol()
    truth = np.full((3, 2, 1), 100)
    counts = {}
    for place, name in enumerate(protocol.approaches):
        for width in (1.5, 1.0):
            correct = rng.integers(10 * place, 10 * place + 20, (3, 2, 1))
            counts[Key(name, "chair", width)] = np.concatenate([correct, correct // 2, truth], axis=-1)
    map_ = np.zeros((20, 20), bool)
    map_[4:9, 5:9] = True
    example = Example(
        Trial("test_0", 1.5, 0),
        "chair",
        Grid(0.1, 20, 20, (-1.0, -1.0)),
        map_,
        map_,
        {name: np.roll(map_, place, axis=0) for place, name in enumerate(protocol.approaches)},
        np.array([[0.0, 0.0, 0.5]]),
    )
    selected = {(name, "chair"): SelectedThreshold(0.35, 0.3, 0.5) for name in protocol.approaches}
    scenes, left_out = {"chair": ["test_0", "test_1", "test_2"]}, {"chair": ["test_3"]}
    snaps = [np.array([0.1, 0.3]), np.array([])]
    seen = {key: np.minimum(count, 8) for key, count in counts.items()}
    return Report(counts, counts, selected, scenes, left_out, [example], snaps, seen, {"chair": 0.5})


def test_the_tables_agree_with_the_counts(tmp_path: Path, report: Report) -> None:
    protocol = make_protocol()
    write_tables(tmp_path, report, protocol, 0.1, ORIGIN)
    text = (tmp_path / "mapping.csv").read_text()
    assert text.startswith(COLUMNS + ",")
    rows = {(row["approach"], row["cell_width"]): row for row in csv.DictReader(text.splitlines())}
    assert len(rows) == 12
    counts = report.counts[Key("imagination", "chair", 1.5)]
    row = rows["imagination", "1.5"]
    assert int(row["trials"]) == 6
    assert int(row["correct_pixels"]) == counts[..., 0].sum()
    assert float(row["iou_pooled"]) == pytest.approx(counts[..., 0].sum() / counts[..., 1:].sum(), abs=5e-5)
    assert float(row["iou_ci_low"]) <= float(row["iou_pooled"]) <= float(row["iou_ci_high"])
    assert float(row["area_m2"]) == pytest.approx(counts[..., 0].sum() * 0.01)
    assert (row["scenes"], row["scenes_left_out"]) == ("3", "1")
    seen = report.seen[Key("imagination", "chair", 1.5)]
    for name, part in (("iou_seen", seen), ("iou_unseen", counts - seen)):
        assert float(row[name]) == pytest.approx(part[..., 0].sum() / part[..., 1:].sum(), abs=5e-5)
    per_trial = list(csv.DictReader((tmp_path / "trials.csv").read_text().splitlines()))
    assert len(per_trial) == 12 * 6
    assert sum(
        int(r["correct_pixels"])
        for r in per_trial
        if (r["approach"], r["cell_width"]) == ("imagination", "1.5")
    ) == int(row["correct_pixels"])


def test_pairs_are_differences_with_an_interval(tmp_path: Path, report: Report) -> None:
    rows = paired_rows(report, make_protocol())
    assert [row["difference"] for row in rows[::2]] == [
        "imagination - seg_gt",
        "imagination - seg_hrnet",
        "imagination - imagination_seen",
        "imagination - seen_dilated",
        "imagination - oracle",
    ]
    iou = {
        (row["approach"], row["category"], row["cell_width"]): float(row["iou_pooled"])
        for row in mapping_rows(report, make_protocol(), 0.1)
    }
    for row in rows:
        ours, theirs = row["difference"].split(" - ")
        place = row["category"], row["cell_width"]
        assert float(row["iou_pooled"]) == pytest.approx(iou[ours, *place] - iou[theirs, *place], abs=1.1e-4)
        assert float(row["ci_low"]) <= float(row["iou_pooled"]) <= float(row["ci_high"])


def test_the_same_report_gives_the_same_bytes(tmp_path: Path, report: Report) -> None:
    for folder in ("a", "b"):
        write_tables(tmp_path / folder / "tables", report, make_protocol(), 0.1, ORIGIN)
        rows = mapping_rows(report, make_protocol(), 0.1)
        write_figures(tmp_path / folder / "figures", report, rows)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert [path.name for path in files] == [
        "iou.png", "maps_chair.png", "mapping.csv", "mapping.md", "paired.csv", "provenance.json", "trials.csv",
    ]  # fmt: skip
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes()
    assert cv2.imread(str(tmp_path / "a" / "figures" / "maps_chair.png")).std() > 0


def test_the_markdown_contains_the_provenance(tmp_path: Path, report: Report) -> None:
    write_tables(tmp_path, report, make_protocol(), 0.1, ORIGIN)
    text = (tmp_path / "mapping.md").read_text()
    for part in (
        "`iou_pooled` divides", "chair: 1 of 4", " 3, of viewpoints, headings and bootstrap 0",
        "a processor, 2 cores", "12 s of wall time", "128 x 128",
        "`python -m imagination.evaluate ckpt=x`", "closed by 0.3 m", "MovingAverage(aggregation_factor=0.9)",
        "| imagination - seen_dilated |",
    ):  # fmt: skip
        assert part in text


def test_the_screen_shows_every_row_in_eighty_columns(report: Report) -> None:
    rows = mapping_rows(report, make_protocol(), 0.1)
    console = Console(width=80, file=StringIO())
    console.print(to_screen(rows, "Global maps", SCREEN_MAPPING))
    assert isinstance(console.file, StringIO)
    shown = console.file.getvalue()
    assert "…" not in shown
    assert all(row["iou_pooled"] in shown for row in rows)
    console.print(to_screen(paired_rows(report, make_protocol()), "Paired differences", SCREEN_PAIRED))
    assert "…" not in console.file.getvalue()


def test_colours_distinguish_correct_false_and_missed(report: Report) -> None:
    example = report.examples[0]
    image = agreement_image(example, np.roll(example.truth, 1, axis=0))
    assert tuple(image[5, 5]) == CORRECT
    assert tuple(image[9, 5]) == FALSE
    assert tuple(image[4, 5]) == MISSED


def test_further_tables_are_written_if_they_have_rows(tmp_path: Path, report: Report) -> None:
    write_tables(tmp_path, report, make_protocol(), 0.1, ORIGIN)
    assert not list(tmp_path.glob("training.csv")) and not list(tmp_path.glob("furniture.csv"))
    training = [{"network": "segmentation_hrnet", "samples": "640"}]
    write_tables(tmp_path, report, make_protocol(), 0.1, ORIGIN, FurtherTables(training, report))
    assert (tmp_path / "training.csv").read_text() == "network,samples\nsegmentation_hrnet,640\n"
    for row in csv.DictReader((tmp_path / "furniture.csv").read_text().splitlines()):
        assert row["iou_known"] == row["iou_unseen"] and row["scenes_known"] == "3"
        assert float(row["ci_low_known"]) <= float(row["iou_known"]) <= float(row["ci_high_known"])
    assert "| segmentation_hrnet | 640 |" in (tmp_path / "mapping.md").read_text()
