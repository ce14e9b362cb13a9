"""Tables in the paper's layout: recounted from the saved maps, best values bold, the paper's numbers as printed."""

import csv
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from imagination.reporting import paper_layout, paper_numbers
from imagination.reporting.load_run import Results
from imagination.reporting.paper_layout import Cell, Column, Layout, Line
from tests.helpers.run_folders import APPROACHES, CATEGORIES, SCENES, make_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_folder(tmp_path_factory.mktemp("made") / "run")


@pytest.fixture(scope="module")
def tables(folder: Path) -> dict[str, Layout]:
    return {table.stem: table for table in paper_layout.tables(Results(folder))}


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
                    assert len(scenes) == (3 if category == "chair" else 2)
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
    """As in mapping.csv; a damaged file is reported and left out."""
    folder = make_folder(tmp_path / "run")
    assert "iou_by_cells" not in {table.stem for table in paper_layout.tables(Results(folder))}
    lines = ["approach,category,cell_width,iou_seen,iou_unseen"]
    lines += [
        f"{name},{category},{width:g},0.{place}{at},0.0{at}"
        for place, name in enumerate(APPROACHES)
        for at, (category, width) in enumerate((c, w) for c in CATEGORIES for w in (3.0, 2.0))
    ]
    path = folder / "tables" / "mapping.csv"
    path.write_text("\n".join(lines) + "\n")
    table = {table.stem: table for table in paper_layout.tables(Results(folder))}["iou_by_cells"]
    (seen, seen_lines), (_, unseen_lines) = table.blocks
    assert "saw" in seen
    for place, line in enumerate(seen_lines):  # columns by width, then category
        values = [cell and cell.value for cell in line.cells]
        assert values == pytest.approx([place / 10 + at for at in (0, 0.02, 0.01, 0.03)])
    assert [cell and cell.value for cell in unseen_lines[2].cells] == [0.0, 0.02, 0.01, 0.03]
    assert [line.name for line in seen_lines if line.cells[0] and line.cells[0].strong] == ["mine"]
    path.write_text("approach,category,cell_width\nimagination,chair,3\n")
    results = Results(folder)
    assert "iou_by_cells" not in {table.stem for table in paper_layout.tables(results)}
    assert any("mapping.csv is damaged" in problem for problem in results.problems)


def test_pairs_are_resampled_together(folder: Path, tables: dict[str, Layout]) -> None:
    """Against a bootstrap written out, with other draws: intervals agree roughly, values exactly."""
    rng = np.random.default_rng(5)
    ((_, lines),) = tables["paired_iou"].blocks
    for other, line in zip([name for name in APPROACHES if name != "imagination"], lines, strict=True):
        ours, theirs = (recount(folder, name, "chair", 3.0) for name in ("imagination", other))

        def difference(picked: np.ndarray, ours: np.ndarray = ours, theirs: np.ndarray = theirs) -> float:
            a, b = ours[picked].sum(axis=0), theirs[picked].sum(axis=0)
            return float(a[0] / a[1:].sum() - b[0] / b[1:].sum())

        samples = [difference(rng.integers(0, 3, 3)) for _ in range(2000)]
        cell = line.cells[0]
        assert cell is not None
        assert cell.value == pytest.approx(difference(np.arange(3)))
        assert (cell.low, cell.high) == pytest.approx(np.quantile(samples, [0.025, 0.975]), abs=0.01)
        assert cell.strong == (cell.low > 0 or cell.high < 0)


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
        names, [Line(name, [Cell(paper_numbers.IOU[name, *column]) for column in columns]) for name in names]
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
        assert r"95\% interval" in text
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
    assert {scene for trials in results.counts.values() for scene, _ in trials} == set(SCENES)
    assert results.problems == []
