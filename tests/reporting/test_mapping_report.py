"""Tables and figures of an evaluation made by hand, from its records."""

import csv
import shutil
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from rich.console import Console

from imagination.evaluation import record_files, saved_maps
from imagination.evaluation.record_files import Evaluation
from imagination.evaluation.records import Example, Key, Report
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.threshold_selection import SelectedThreshold
from imagination.evaluation.trials import Trial
from imagination.geometry.grid import Grid
from imagination.report import read
from imagination.reporting.figures.maps import CORRECT, FALSE, MISSED, agreement_image
from imagination.reporting.load_run import Results
from imagination.reporting.mapping_report import main_tables
from imagination.reporting.results_folder import write_results
from imagination.reporting.tables import SCREEN_MAPPING, SCREEN_PAIRED, to_screen
from imagination.scenes.source import Credit
from imagination.utils.errors import UserError
from imagination.utils.provenance import Provenance
from tests.helpers.run_folders import read_about
from tests.helpers.toy_evaluation import make_model, make_protocol

SCENES = 6
COLUMNS = (
    "approach,category,cell_width,trials,seeds,iou_pooled,iou_mean,iou_ci_low,iou_ci_high,iou_seed_std,"
    "correct_pixels,false_positives,gt_pixels"
)
ORIGIN = Provenance(
    "2026-11-30T12:00:00+00:00",
    "0.1.0",
    "0123abc",
    "python -m imagination.evaluate ckpt=x",
    "a processor, 2 cores",
)


@pytest.fixture
def report() -> Report:
    rng = np.random.default_rng(0)
    protocol = make_protocol()
    truth = np.full((SCENES, 2, 1), 100)
    counts = {}
    for place, name in enumerate(protocol.approaches):
        for width in (1.5, 1.0):
            correct = rng.integers(10 * place, 10 * place + 20, (SCENES, 2, 1))
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
    scenes = {"chair": [f"test_{number}" for number in range(SCENES)]}
    left_out = {"chair": [f"test_{SCENES}"]}
    snaps = [np.array([0.1, 0.3]), np.array([])]
    seen = {key: np.minimum(count, 8) for key, count in counts.items()}
    return Report(counts, counts, selected, scenes, left_out, [example], snaps, seen, {"chair": 0.5})


@pytest.fixture
def written(report: Report, tmp_path: Path) -> Path:
    """Folder with the config, the records and the maps of the example."""
    return write_folder(tmp_path / "run", report)


def write_folder(folder: Path, report: Report, **changes: Any) -> Path:
    setting = make_model(folder / "cache", ("chair",)).setting
    networks = [{"network": "unit", "kind": "maps", "category": "chair", "samples": "640"}]
    evaluation = Evaluation(make_protocol(), setting, report, None, networks, (), 3, 12.3, ORIGIN)
    record_files.write(folder, evaluation._replace(**changes))
    config = {
        "name": "made",
        "seed": evaluation._replace(**changes).seed,
        "ego": {"resolution": 0.1},
        "unit_categories": ["chair"],
        "evaluation": {"cell_widths": [1.5, 1.0], "viewpoint_sets": 2, "resamples": 100, "seed": 0},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    for example in report.examples:
        names = list(example.predicted)
        shape = len(names), 1, *example.truth.shape
        level = 99 * np.stack([example.predicted[name] for name in names]).astype(np.uint8).reshape(shape)
        saved_maps.save(
            folder,
            SavedMaps(
                example.trial, names, ["chair"], level, np.full(shape[:2], 50, np.uint8), example.truth[None],
                np.array([True]), example.occupied, example.occupied, example.poses, example.grid,
            ),
        )  # fmt: skip
    return folder


def rows_of(folder: Path, name: str) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "tables" / f"{name}.csv").read_text().splitlines()))


def test_the_tables_agree_with_the_counts(written: Path, report: Report) -> None:
    write_results(written)
    assert (written / "tables" / "mapping.csv").read_text().splitlines()[0] == COLUMNS
    rows = {(row["approach"], row["cell_width"]): row for row in rows_of(written, "mapping")}
    assert len(rows) == 12
    counts = report.counts[Key("imagination", "chair", 1.5)]
    row = rows["imagination", "1.5"]
    assert (int(row["trials"]), row["seeds"], row["iou_seed_std"]) == (2 * SCENES, "1", "")
    assert int(row["correct_pixels"]) == counts[..., 0].sum()
    assert float(row["iou_pooled"]) == pytest.approx(counts[..., 0].sum() / counts[..., 1:].sum(), abs=5e-5)
    each = counts[..., 0] / counts[..., 1:].sum(axis=-1)
    assert float(row["iou_mean"]) == pytest.approx(each.mean(), abs=5e-5)
    assert float(row["iou_ci_low"]) <= float(row["iou_pooled"]) <= float(row["iou_ci_high"])
    (seeds,) = [
        each
        for each in rows_of(written, "mapping_seeds")
        if (each["approach"], each["cell_width"]) == ("imagination", "1.5")
    ]
    assert seeds["seed"] == "3"
    assert all(seeds[name] == row[name] for name in ("iou_pooled", "iou_mean", "correct_pixels", "gt_pixels"))
    (details,) = [
        each
        for each in rows_of(written, "mapping_details")
        if (each["approach"], each["cell_width"]) == ("imagination", "1.5")
    ]
    assert float(details["area_m2"]) == pytest.approx(counts[..., 0].sum() * 0.01)
    assert (details["scenes"], details["scenes_left_out"]) == (str(SCENES), "1")
    seen = report.seen[Key("imagination", "chair", 1.5)]
    for name, part in (("iou_seen", seen), ("iou_unseen", counts - seen)):
        assert float(details[name]) == pytest.approx(part[..., 0].sum() / part[..., 1:].sum(), abs=5e-5)


def test_pairs_are_differences_with_an_interval(written: Path) -> None:
    write_results(written)
    rows = rows_of(written, "paired")
    assert [row["difference"] for row in rows[::2]] == [
        "imagination - seg_gt",
        "imagination - seg_hrnet",
        "imagination - imagination_seen",
        "imagination - seen_dilated",
        "imagination - oracle",
    ]
    iou = {
        (row["approach"], row["category"], row["cell_width"]): float(row["iou_pooled"])
        for row in rows_of(written, "mapping")
    }
    for row in rows:
        ours, theirs = row["difference"].split(" - ")
        place = row["category"], row["cell_width"]
        assert float(row["iou_pooled"]) == pytest.approx(iou[ours, *place] - iou[theirs, *place], abs=1.1e-4)
        assert float(row["ci_low"]) <= float(row["iou_pooled"]) <= float(row["ci_high"])


def test_the_report_from_the_records_alone_equals_that_of_the_run(written: Path, tmp_path: Path) -> None:
    write_results(written)
    names = {path.name for path in (written / "tables").iterdir()}
    assert names == {
        "mapping.csv", "mapping_seeds.csv", "mapping_details.csv", "paired.csv", "training.csv", "mapping.md",
    }  # fmt: skip
    assert {path.name for path in (written / "figures").iterdir()} == {"iou.png", "first_scene_chair.png"}
    before = {
        path: path.read_bytes() for name in ("tables", "figures") for path in (written / name).iterdir()
    }
    for name in ("tables", "figures"):
        shutil.rmtree(written / name)
    write_results(written)
    assert {path: path.read_bytes() for path in before} == before
    assert cv2.imread(str(written / "figures" / "first_scene_chair.png")).std() > 0
    assert {
        name: text.encode() for name, text in read(written).tables.items()
    } == {path.name: content for path, content in before.items() if path.parent.name == "tables"}  # fmt: skip


def test_several_seeds_are_combined(report: Report, tmp_path: Path) -> None:
    """A study has a folder for each seed; its own tables hold means, deviations and intervals of all."""
    study = tmp_path / "study"
    more = {key: counts + [1, 0, 0] for key, counts in report.counts.items()}
    first = write_folder(study / "seed_0", report, seed=0)
    write_folder(study / "seed_7", report._replace(counts=more, seen=more, shuffled=more), seed=7)
    config = yaml.safe_load((first / "config.yaml").read_text())
    (study / "config.yaml").write_text(yaml.safe_dump({**config, "seeds": [0, 7]}))
    write_folder(study / "seed_9", report, seed=9)  # of an earlier study
    write_results(study)
    write_results(first)
    single = rows_of(first, "mapping")
    for row, one in zip(rows_of(study, "mapping"), single, strict=True):
        assert (row["seeds"], row["trials"]) == ("2", one["trials"])
        assert (
            float(row["correct_pixels"]) == int(one["correct_pixels"]) + SCENES
        )  # two sets, half of the seeds
        both = [
            float(each["iou_pooled"])
            for each in rows_of(study, "mapping_seeds")
            if all(each[name] == row[name] for name in ("approach", "category", "cell_width"))
        ]
        assert float(row["iou_pooled"]) == pytest.approx(np.mean(both), abs=1e-4)
        assert float(row["iou_seed_std"]) == pytest.approx(np.std(both, ddof=1), abs=1e-4)
    assert {row["seed"] for row in rows_of(study, "training")} == {"0", "7"}
    assert "means over training seeds" in (study / "tables" / "mapping.md").read_text()
    layout = read(study).sections[0].layouts[0]
    assert "±" in layout.spread(next(cell for cell in layout.blocks[0][1][0].cells if cell))


def test_the_markdown_contains_the_provenance(written: Path) -> None:
    write_results(written)
    text = (written / "tables" / "mapping.md").read_text()
    for part in (
        "`iou_pooled` divides", f"chair: 1 of {SCENES + 1}", " 3, of viewpoints, headings and bootstrap 0",
        "a processor, 2 cores", "12 s of wall time", "48 x 48 pixels", "imagination 0.1.0, commit 0123abc",
        "`python -m imagination.evaluate ckpt=x`", "closed by 0.3 m", "MovingAverage(aggregation_factor=0.9)",
        "| imagination - seen_dilated |", "2026-11-30T12:00:00+00:00", f"Folder: `{written}`",
    ):  # fmt: skip
        assert part in text


def test_the_path_of_the_records_is_not_a_link(report: Report, tmp_path: Path) -> None:
    (tmp_path / "2026").mkdir()
    (tmp_path / "latest").symlink_to("2026")
    write_folder(tmp_path / "latest", report)
    assert read_about(tmp_path / "2026")["folder"] == str(tmp_path / "2026")


def test_results_without_records_are_refused(written: Path) -> None:
    shutil.rmtree(written / "records")
    with pytest.raises(UserError, match=rf"folder: got {written}, expected the records.*run/records"):
        write_results(written)


def test_the_screen_shows_every_row_in_eighty_columns(written: Path) -> None:
    results = Results(written)
    console = Console(width=80, file=StringIO())
    rows = main_tables(results)
    console.print(to_screen(rows["mapping"], "Global maps", SCREEN_MAPPING))
    assert isinstance(console.file, StringIO)
    shown = console.file.getvalue()
    assert "…" not in shown and "seed" not in shown
    assert all(row["iou_pooled"] in shown for row in rows["mapping"])
    console.print(to_screen(rows["paired"], "Paired differences", SCREEN_PAIRED))
    assert "…" not in console.file.getvalue()


def test_colours_distinguish_correct_false_and_missed(report: Report) -> None:
    example = report.examples[0]
    image = agreement_image(example, np.roll(example.truth, 1, axis=0))
    assert tuple(image[5, 5]) == CORRECT
    assert tuple(image[9, 5]) == FALSE
    assert tuple(image[4, 5]) == MISSED


def test_further_tables_are_written_if_they_have_rows(report: Report, tmp_path: Path) -> None:
    without = write_folder(tmp_path / "without", report, networks=[])
    write_results(without)
    assert not list((without / "tables").glob("training.csv")) + list(
        (without / "tables").glob("furniture.csv")
    )
    credit = Credit("test", "chair", "=model()", "an author", "CC BY 4.0", "https://example.org")
    network = {"network": "segmentation_hrnet", "kind": "images", "category": "chair", "samples": "640"}
    written = write_folder(tmp_path / "with", report, networks=[network], known=report, credits=[credit])
    write_results(written)
    assert (written / "tables" / "training.csv").read_text().splitlines() == [
        "network,seed,category,samples,iou_first_person",
        "segmentation_hrnet,3,chair,640,0.5000",
    ]
    assert "chair,'=model(),an author" in (written / "tables" / "credits.csv").read_text()
    for row in rows_of(written, "furniture"):
        assert row["iou_known"] == row["iou_unseen"] and row["scenes_known"] == str(SCENES)
        assert float(row["ci_low_known"]) <= float(row["iou_known"]) <= float(row["ci_high_known"])
    assert "| segmentation_hrnet | 3 | chair | 640 |" in (written / "tables" / "mapping.md").read_text()
