"""Tables in the paper's layout: recounted from the saved maps, best values bold, the paper's numbers as printed."""

import csv
import math
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from imagination.reporting import paper_layout, paper_numbers
from imagination.reporting.load_run import Results
from imagination.reporting.paper_layout import Cell, Column, Layout, Line
from imagination.reporting.statistics import Estimate
from tests.helpers.run_folders import APPROACHES, CATEGORIES, SCENES, make_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_folder(tmp_path_factory.mktemp("made") / "run")


def tables_of(folder: Path) -> dict[str, Layout]:
    return {table.stem: table for table in paper_layout.tables(Results(folder))}


@pytest.fixture(scope="module")
def tables(folder: Path) -> dict[str, Layout]:
    return tables_of(folder)


def recount(folder: Path, approach: str, category: str, width: float) -> np.ndarray:
    """Count correct, false-positive and ground-truth pixels of each scene from the saved maps with NumPy."""
    totals: dict[str, np.ndarray] = {}
    for path in sorted((folder / "maps").glob(f"*_{width:g}m_*.npz")):
        with np.load(path, allow_pickle=False) as maps:
            place, layer = (
                maps["approaches"].tolist().index(approach),
                maps["categories"].tolist().index(category),
            )
            truth = maps["truth"][layer]
            predicted = maps["level"][place, layer] >= maps["threshold"][place, layer]
            if maps["present"][layer]:
                counts = [(predicted & truth).sum(), (predicted & ~truth).sum(), truth.sum()]
                totals[str(maps["scene"])] = totals.get(str(maps["scene"]), 0) + np.array(counts)
    return np.array(list(totals.values()))


def test_tables_agree_with_a_recount_from_the_saved_maps(folder: Path, tables: dict[str, Layout]) -> None:
    for stem in ("iou", "correct_pixels"):
        rows = list(csv.reader(StringIO(paper_layout.to_csv(tables[stem]))))
        head, ours = rows[0], rows[1 : 1 + len(APPROACHES)]
        for approach, row in zip(APPROACHES, ours, strict=True):
            for category in CATEGORIES:
                for width in (3.0, 2.0):
                    scenes = recount(folder, approach, category, width)
                    assert len(scenes) == (6 if category == "chair" else 5)
                    correct, false, truth = scenes.sum(axis=0)
                    expected = correct / (false + truth) if stem == "iou" else correct
                    at = head.index(f"{category}_{width:g}m")
                    assert float(row[at]) == pytest.approx(expected, abs=6e-4)
                    low, high = float(row[at + 1]), float(row[at + 2])
                    each = (
                        scenes[:, 0] / scenes[:, 1:].sum(axis=1)
                        if stem == "iou"
                        else len(scenes) * scenes[:, 0]
                    )
                    assert each.min() - 6e-4 <= low <= high <= each.max() + 6e-4
                    assert low < high


def test_seen_and_unseen_cells_stand_apart(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    path = folder / "records" / "trials.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    place = [rows[0].index(f"{name}_seen") for name in ("correct_pixels", "false_positives", "gt_pixels")]
    for row in rows[1:]:
        for column, value in zip(place, (10, 5, 40), strict=True):
            row[column] = str(value)
    path.write_text("\n".join(map(",".join, rows)) + "\n")
    (seen, seen_lines), (_, unseen_lines) = tables_of(folder)["iou_by_cells"].blocks
    assert "saw" in seen
    assert {cell and cell.value for line in seen_lines for cell in line.cells} == {10 / 45}
    counts = recount(folder, "imagination", "chair", 3.0).sum(axis=0) - 12 * np.array([10, 5, 40])
    cell = unseen_lines[APPROACHES.index("imagination")].cells[0]
    assert cell and cell.value == counts[0] / counts[1:].sum()


def test_too_few_scenes_have_no_interval_and_no_best_value(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    path = folder / "records" / "trials.csv"
    lines = [line for line in path.read_text().splitlines() if "test_0001" not in line]
    path.write_text("\n".join(lines) + "\n")  # leaves five scenes with chairs, four with beds
    for stem, table in tables_of(folder).items():
        ours = table.blocks[0][1]
        for place, at in enumerate(table.columns):
            cells = [cell for line in ours if (cell := line.cells[place])]
            if at.category == "bed":
                assert not any(cell.strong or math.isfinite(cell.estimate.low) for cell in cells), stem
            elif stem != "iou_by_cells":
                assert all(math.isfinite(cell.estimate.low) for cell in cells), stem


def test_pairs_are_resampled_together(folder: Path, tables: dict[str, Layout]) -> None:
    """Against a bootstrap written out, with other draws: intervals agree roughly, values exactly."""
    rng = np.random.default_rng(5)
    ((_, lines),) = tables["paired_iou"].blocks
    for other, line in zip([name for name in APPROACHES if name != "imagination"], lines, strict=True):
        ours, theirs = (recount(folder, name, "chair", 3.0) for name in ("imagination", other))

        def difference(picked: np.ndarray, ours: np.ndarray = ours, theirs: np.ndarray = theirs) -> float:
            a, b = ours[picked].sum(axis=0), theirs[picked].sum(axis=0)
            return float(a[0] / a[1:].sum() - b[0] / b[1:].sum())

        samples = [difference(rng.integers(0, 6, 6)) for _ in range(2000)]
        cell = line.cells[0]
        assert cell is not None
        assert cell.value == pytest.approx(difference(np.arange(6)))
        interval = cell.estimate.low, cell.estimate.high
        assert interval == pytest.approx(np.quantile(samples, [0.025, 0.975]), abs=0.01)
        assert cell.strong == (interval[0] > 0 or interval[1] < 0)


def test_the_best_approach_that_does_not_see_the_ground_truth_is_bold(tables: dict[str, Layout]) -> None:
    for _, lines in tables["iou"].blocks:
        for column in range(4):
            cells = {line.name: line.cells[column] for line in lines}
            best = [name for name, cell in cells.items() if cell and cell.strong]
            ranked = {name: cell.value for name, cell in cells.items() if cell and name != "Seg. with GT"}
            assert best == [max(ranked, key=lambda name: ranked[name])]


def test_the_papers_numbers_and_their_bold_ones_are_as_printed() -> None:
    """Spot checks against the paper's page; its bold cells follow from the numbers."""
    assert len(paper_numbers.IOU) == len(paper_numbers.CORRECT_PIXELS) == 36
    assert paper_numbers.IOU["imagination", 3.0, "chair"] == 0.197
    assert paper_numbers.IOU["seg_hrnet", 2.0, "table"] == 0.214
    assert paper_numbers.CORRECT_PIXELS["imagination", 2.5, "bed"] == 2859842
    assert paper_numbers.CORRECT_PIXELS["seg_gt", 2.0, "table"] == 2648728
    columns = [Column(width, category) for width in (3.0, 2.5, 2.0) for category in ("chair", "bed", "table")]
    names = ["seg_gt", "seg_hrnet", "imagination_seen", "imagination"]
    lines = paper_layout.mark_best(
        names,
        [
            Line(name, [Cell(Estimate(paper_numbers.IOU[name, *column])) for column in columns])
            for name in names
        ],
        [True] * len(columns),
    )
    bold = [[place for place, line in enumerate(lines) if line.cells[at].strong] for at in range(9)]  # type: ignore
    assert bold == [[3], [3], [3], [3], [1], [3], [3], [1], [1]]


def test_the_papers_rows_are_named_as_matterports(tables: dict[str, Layout]) -> None:
    (ours, _), (theirs, lines) = tables["iou"].blocks
    assert ours == "Ours, on Rooms" and theirs == "Paper, on Matterport3D"
    assert [line.name for line in lines] == ["Seg. with GT", "Imagination (seen)", "Imagination"]
    assert "0.1 m" in tables["correct_pixels"].note and "0.02 m" in tables["correct_pixels"].note


def test_markdown_and_latex_have_a_cell_for_each_column(tables: dict[str, Layout]) -> None:
    for table in tables.values():
        rows = [line for line in paper_layout.to_markdown(table).splitlines() if line.startswith("|")]
        assert {row.count("|") for row in rows} == {6}
        text = paper_layout.to_latex(table)
        assert text.count("{") == text.count("}")
        body = [line for line in text.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
        assert {line.count("&") for line in body} == {4}
        assert (r"95\% interval" in text) == (table.stem != "iou_by_cells")
    assert r"$\mathbf{" in paper_layout.to_latex(tables["iou"]) and "**" in paper_layout.to_markdown(
        tables["iou"]
    )


def test_names_cannot_break_a_table() -> None:
    table = Layout(
        "x", "a_b", "50 % & more", [Column(2.0, "arm|chair_1")], [("", [Line("$me", [None])])], ".3f"
    )
    assert r"a\_b. 50 \% \& more" in paper_layout.to_latex(table)
    assert r"arm|chair\_1" in paper_layout.to_latex(table) and r"\$me & --" in paper_layout.to_latex(table)
    assert r"arm\|chair_1" in paper_layout.to_markdown(table) and "| $me | – |" in paper_layout.to_markdown(
        table
    )


def test_all_scenes_are_used(folder: Path) -> None:
    results = Results(folder)
    assert results.scenes == SCENES
    assert results.problems == []
