"""Sweeps: swept values are found, failed and missing jobs are reported, and the rest is shown."""

import csv
import re
import shutil
from collections.abc import Callable
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from imagination.report import read
from imagination.reporting import best_setting
from imagination.reporting.load_sweep import MAX_JOBS, Multirun, grid
from imagination.reporting.paper_layout import Column
from imagination.reporting.sweep_report import SweepReport
from imagination.utils.errors import UserError
from tests.helpers.run_folders import make_folder, read_about, set_command, write_about

SWEPT = ["+experiment=made", "kernels.imaginable=0.6,1.0,1.4", "model.alpha_max=10,30"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a sweep over two keys with six complete jobs."""
    folder = tmp_path_factory.mktemp("sweep") / "multirun"
    folder.mkdir()
    sweeper = {"_target_": "hydra._internal.core_plugins.basic_sweeper.BasicSweeper", "params": None}
    hydra = {"hydra": {"sweeper": sweeper, "overrides": {"task": SWEPT}, "job": {"name": "train"}}}
    (folder / "multirun.yaml").write_text(yaml.safe_dump(hydra))
    number = 0
    for delta in ("0.6", "1.0", "1.4"):
        for alpha in ("10", "30"):
            make_folder(
                folder / str(number), drawn=number, kernels={"imaginable": float(delta)}, paths={"run": str(number)},
                data={"scenes": {"_target_": "tests.sources.Rooms"}, "delta": float(delta)},
                model={"alpha_max": int(alpha)},
                choices=["+experiment=made", f"kernels.imaginable={delta}", f"model.alpha_max={alpha}"],
            )  # fmt: skip
            number += 1
    return folder


@pytest.fixture
def sweep(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "multirun")


def test_hydras_grid_gives_the_jobs(sweep: Path) -> None:
    overrides = grid(sweep / "multirun.yaml")
    assert len(overrides) == 6
    assert overrides[3] == {"kernels.imaginable": "1.0", "model.alpha_max": "30"}
    assert grid(sweep / "nothing.yaml") == []


@pytest.mark.parametrize(
    ("task", "jobs"),
    [
        (["a=1,2", "b=["], 0),  # no override
        ("a=1,2", 0),
        ([5], 0),
        (["a=range(0,1000000000)"], MAX_JOBS),
        ([f"a{number}=1,2,3,4,5,6,7,8,9" for number in range(20)], MAX_JOBS),
    ],
)
def test_a_damaged_grid_is_ignored(tmp_path: Path, task: object, jobs: int) -> None:
    """A grid that would fill memory is limited."""
    sweeper = {"_target_": "hydra._internal.core_plugins.basic_sweeper.BasicSweeper", "params": None}
    hydra = {"hydra": {"sweeper": sweeper, "overrides": {"task": task}}}
    (tmp_path / "multirun.yaml").write_text(yaml.safe_dump(hydra))
    assert len(grid(tmp_path / "multirun.yaml")) == jobs


def test_six_jobs_differ_only_in_the_swept_keys(sweep: Path) -> None:
    found = Multirun(sweep)
    assert list(found.swept) == ["kernels.imaginable", "model.alpha_max"]
    assert [found.values(job) for job in found.jobs] == grid(sweep / "multirun.yaml")
    content = read(sweep)
    assert content.problems == []
    assert content.commands == [
        "python -m imagination.train -m +experiment=made kernels.imaginable=0.6,1.0,1.4 model.alpha_max=10,30",
        f"python -m imagination.report folder={sweep}",
    ]
    table, paired = [table for section in content.sections for table in section.layouts]
    assert [len(lines) for _, lines in table.blocks] == [6, 6, 6, 6]
    assert [line.name for line in paired.blocks[0][1]] == [line.name for line in table.blocks[0][1][1:]]
    assert table.blocks[0][1][0].name == "kernels.imaginable=0.6, model.alpha_max=10"
    first = read(sweep / "0").sections[0].layouts[0].blocks[0][1][0].cells[0]
    assert first and table.blocks[0][1][0].cells[0] == first._replace(
        strong=table.blocks[0][1][0].cells[0].strong
    )  # type: ignore[union-attr]
    stems = [drawing.stem for section in content.sections for drawing in section.drawings]
    keys = "kernels.imaginable", "model.alpha_max"
    assert stems == [f"ablation_{key}__{of}" for key in keys for of in ("chair", "bed")]


def validated(sweep: Path, number: int, iou: float) -> None:
    """Write a job's IoU on validation scenes into its records."""
    about = read_about(sweep / str(number))
    write_about(
        sweep / str(number), {**about, "selected": [{**each, "iou": iou} for each in about["selected"]]}
    )


def strong(sweep: Path) -> set[int]:
    table = next(table for section in read(sweep).sections for table in section.layouts)
    blocks = [lines for _, lines in table.blocks]
    return {
        row
        for lines in blocks
        for row, line in enumerate(lines)
        for cell in line.cells
        if cell and cell.strong
    }


def test_the_best_on_validation_scenes_is_bold(sweep: Path) -> None:
    """Independent of test scenes; no job is bold if their ground truth differs."""
    assert strong(sweep) == set()
    for number in range(6):
        validated(sweep, number, 0.3 + 0.1 * (number == 4))
    assert strong(sweep) == {4}
    table = sweep / "2" / "records" / "trials.csv"
    head, *lines = table.read_text().splitlines()
    table.write_text("\n".join([head, *(f"{line}0".replace(",70,", ",700,") for line in lines)]) + "\n")
    assert strong(sweep) == set()  # ten times the ground truth
    (layout,) = [layout for section in read(sweep).sections for layout in section.layouts]
    assert "different ground truth" in layout.note


@pytest.mark.slow
def test_swept_values_are_found_in_configs_without_overrides(sweep: Path) -> None:
    """As in evaluations; of two keys that vary together one is named."""
    (sweep / "multirun.yaml").unlink()
    command = "python -m imagination.train +experiment=made +hparams_search=optuna"
    set_command(sweep / "0", "python -m somebody.s worker")
    assert read(sweep).commands == [f"python -m imagination.report folder={sweep}"]
    set_command(sweep / "0", f"{command} hydra.sweep.dir=old")
    assert read(sweep).commands == [
        command,
        f"python -m imagination.report folder={sweep}",
    ]  # the command of the search
    for path in sweep.glob("*/config.yaml"):
        config = yaml.safe_load(path.read_text())
        path.write_text(yaml.safe_dump({**config, "choices": []}))
    found = Multirun(sweep)
    assert sorted(found.swept) == ["data.delta", "model.alpha_max"] or sorted(found.swept) == [
        "kernels.imaginable",
        "model.alpha_max",
    ]
    assert found.values(found.jobs[5]) in (
        {"data.delta": "1.4", "model.alpha_max": "30"}, {"kernels.imaginable": "1.4", "model.alpha_max": "30"}
    )  # fmt: skip


def test_failed_and_missing_jobs_are_reported_and_the_rest_is_shown(sweep: Path) -> None:
    shutil.rmtree(sweep / "5")
    shutil.rmtree(sweep / "1" / "records")
    shutil.rmtree(sweep / "1" / "maps")
    (sweep / "1" / "run.log").write_text(
        "INFO\nERROR root: The run failed\nTraceback …\nRuntimeError: out of luck\n"
    )
    (sweep / "2" / "config.yaml").write_text("a: [")
    for name in ("records", "maps"):
        shutil.rmtree(sweep / "3" / name)
    content = read(sweep)
    failed, broken, unfinished, missing = content.problems
    assert re.match(
        r"job 1 \(kernels.imaginable=0.6, model.alpha_max=30\).*failed.*RuntimeError: out of luck", failed
    )
    assert re.match(r"job 2 \(kernels.imaginable=1.0, model.alpha_max=10\).*failed", broken)
    assert "2/config.yaml: cannot be read" in broken
    assert "job 3" in unfinished and "unfinished" in unfinished
    assert re.match(r"job 5 \(kernels.imaginable=1.4, model.alpha_max=30\).*missing", missing)
    table = next(table for section in content.sections for table in section.layouts)
    assert [line.name for line in table.blocks[0][1]] == [
        "kernels.imaginable=0.6, model.alpha_max=10", "kernels.imaginable=1.4, model.alpha_max=10",
    ]  # fmt: skip
    states = [row["state"] for section in content.sections for plain in section.plain for row in plain.rows]
    assert states == ["complete", "failed", "failed", "unfinished", "complete", "missing"]


def only_lines(folder: Path, keep: Callable[[str], bool]) -> None:
    """Leave some rows of a job's trials.csv."""
    table = folder / "records" / "trials.csv"
    head, *lines = table.read_text().splitlines()
    table.write_text("\n".join([head, *filter(keep, lines)]) + "\n")


def test_a_sweep_over_cell_widths_is_one_table_and_one_curve(tmp_path: Path) -> None:
    folder = tmp_path / "multirun"
    for number, width in enumerate((3.0, 2.0)):
        job = make_folder(folder / str(number), choices=[f"evaluation.cell_widths=[{width}]"])
        only_lines(job, lambda line, width=width: f",{width:g},test" in line)  # type: ignore[misc]
        config = yaml.safe_load((job / "config.yaml").read_text())
        config["evaluation"]["cell_widths"] = [width]
        (job / "config.yaml").write_text(yaml.safe_dump(config))
    content = read(folder)
    assert content.problems == []
    (table,) = content.sections[1].layouts
    assert [(at.cell_width, at.category) for at in table.columns] == [
        (width, category) for width in (3.0, 2.0) for category in ("chair", "bed")
    ]
    whole = read(make_folder(tmp_path / "whole")).sections[0].layouts[0]
    ((_, lines),) = table.blocks
    assert [line.name for line in lines] == [line.name for line in whole.blocks[0][1]]
    for line, expected in zip(lines, whole.blocks[0][1], strict=True):
        assert [cell and cell.estimate for cell in line.cells] == [
            cell and cell.estimate for cell in expected.cells
        ]
    (drawing,) = content.sections[1].drawings
    axes = drawing.draw().axes
    assert [axis.get_title() for axis in axes] == ["chair", "bed"]
    assert axes[0].get_xlabel() == "cell width, m"


def test_jobs_without_a_common_category_are_drawn(tmp_path: Path) -> None:
    """A unit of chairs and a segmentation network of chairs and beds, with two seeds each."""
    for number, (experiment, seed) in enumerate((e, s) for e in ("chair_unet", "hrnet") for s in (0, 1)):
        folder = make_folder(
            tmp_path / str(number), number, seed=seed, choices=[f"+experiment={experiment}", f"seed={seed}"]
        )
        left = ",bed," if experiment == "chair_unet" else "imagination,"
        only_lines(folder, lambda line, left=left: left not in line)  # type: ignore[misc]
    drawn = [drawing for section in read(tmp_path).sections for drawing in section.drawings]
    assert [drawing.stem for drawing in drawn] == ["ablation_experiment__chair", "ablation_experiment__bed"]
    (line,) = best_setting.summary(Multirun(tmp_path))
    assert "No best setting" in line  # the settings have other categories
    for drawing in drawn:
        drawing.draw()


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a sweep over two settings with three training seeds each."""
    folder = tmp_path_factory.mktemp("seeds")
    for number, (alpha, seed) in enumerate((alpha, seed) for alpha in (10, 30) for seed in (0, 1, 2)):
        job = make_folder(
            folder / str(number), number, seed=seed, model={"alpha_max": alpha},
            choices=["+experiment=made", f"model.alpha_max={alpha}", f"seed={seed}"],
        )  # fmt: skip
        validated(folder, number, 0.01 * alpha + 0.01 * seed)
        assert job.is_dir()
    return folder


def test_jobs_that_differ_in_the_seed_are_one_setting(seeds: Path) -> None:
    """The table has means and deviations over seeds, against numbers counted from the records by hand."""
    content = read(seeds)
    table, paired = content.sections[1].layouts
    assert [line.name for line in table.blocks[0][1]] == ["model.alpha_max=10", "model.alpha_max=30"]
    assert [drawing.stem for drawing in content.sections[1].drawings] == [
        f"ablation_model.alpha_max__{category}" for category in ("chair", "bed")
    ]
    values = []
    for number in range(6):
        rows = csv.DictReader((seeds / str(number) / "records" / "trials.csv").open())
        chosen = [
            row
            for row in rows
            if (row["approach"], row["category"], row["cell_width"]) == ("mine", "bed", "2")
        ]
        correct, false, gt = (
            sum(int(row[name]) for row in chosen)
            for name in ("correct_pixels", "false_positives", "gt_pixels")
        )
        values.append(correct / (false + gt))
    place = table.columns.index(Column(2.0, "bed"))
    for setting, line in enumerate(dict(table.blocks)["mine"]):
        cell, ours = line.cells[place], values[3 * setting : 3 * setting + 3]
        assert cell is not None
        assert cell.value == pytest.approx(np.mean(ours))
        assert cell.estimate.seed_std == pytest.approx(np.std(ours, ddof=1))
        assert cell.estimate.low < cell.value < cell.estimate.high
    ours = [line.cells[place] for line in dict(table.blocks)["Imagination"]]
    (difference,) = [line.cells[place] for line in paired.blocks[0][1]]
    assert difference and ours[0] and ours[1]
    assert difference.value == pytest.approx(ours[1].value - ours[0].value)


def test_a_sweep_over_seeds_alone_is_one_setting(seeds: Path, tmp_path: Path) -> None:
    for number in range(3):
        shutil.copytree(seeds / str(number), tmp_path / str(number))
    content = read(tmp_path)
    (table,) = content.sections[1].layouts
    ((_, lines),) = table.blocks
    assert [line.name for line in lines][:2] == ["Seg. with GT", "Imagination (seen)"]
    assert all(cell and cell.estimate.seed_std > 0 for line in lines for cell in line.cells)
    rows = list(csv.DictReader(StringIO(content.tables["mapping.csv"])))
    assert {(row["seeds"], row["trials"]) for row in rows if row["category"] == "chair"} == {("3", "12")}
    each = list(csv.DictReader(StringIO(content.tables["mapping_seeds.csv"])))
    assert len(each) == 3 * len(rows) and {row["seed"] for row in each} == {"0", "1", "2"}
    assert best_setting.summary(Multirun(tmp_path)) == []  # nothing to select


def test_the_end_of_a_sweep_names_the_best_setting_and_the_report(
    seeds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("imagination.reporting.html.html", lambda content: "")  # draws every figure
    monkeypatch.setattr("imagination.reporting.html.write_figures", lambda folder, content: None)
    folder = shutil.copytree(seeds, tmp_path / "multirun")
    hydra = OmegaConf.create({"hydra": {"sweep": {"dir": str(folder)}}})
    SweepReport().on_multirun_end(hydra)
    shown = capsys.readouterr()
    assert "Best setting on validation scenes (Imagination, IoU 0.3100): model.alpha_max=30" in shown.err
    assert re.search(
        r"bed, cell width 2 m: test IoU 0\.\d{4} ± 0\.\d{4} over 3 seeds \[0\.\d{4}, ", shown.err
    )
    assert f"Report: {folder / 'report.html'}" in shown.err
    rows = [line.split() for line in shown.out.splitlines() if " chair " in line or " bed " in line]
    assert [row[:3] for row in rows[:2]] == [["10", "chair", "3"], ["10", "chair", "2"]] and len(rows) == 8
    assert "Sweep, Imagination" in shown.out and "…" not in shown.out
    assert (folder / "tables" / "mapping.csv").is_file()
    for number in range(6):
        (folder / str(number) / "records" / "trials.csv").write_text("nothing")
        shutil.rmtree(folder / str(number) / "maps")
    SweepReport().on_multirun_end(hydra)
    assert (
        f"error: no report on {folder}: folder: got {folder}, none of whose 6 jobs" in capsys.readouterr().err
    )


def test_a_sweep_that_left_nothing_is_refused(tmp_path: Path) -> None:
    (tmp_path / "0").mkdir()
    with pytest.raises(UserError, match=r"folder: got .*none of whose 1 jobs"):
        read(tmp_path)


def test_the_jobs_of_the_sweeps_list_are_used(sweep: Path) -> None:
    """As imagination.runs.sweep writes it, with the problem of a failed job; a job that never began has no folder."""
    (sweep / "multirun.yaml").unlink()
    shutil.rmtree(sweep / "4")
    lines = ["folder,key,state,score,overrides,problem"]
    for number, (delta, alpha) in enumerate((d, a) for d in ("0.6", "1.0", "1.4") for a in ("10", "30")):
        state, problem = {2: ("failed", "out of luck"), 4: ("missing", ""), 6: ("missing", "")}.get(
            number, ("done", "")
        )
        lines.append(
            f"{number},hash,{state},,+experiment=made kernels.imaginable={delta} model.alpha_max={alpha},{problem}"
        )
    (sweep / "jobs.csv").write_text("\n".join(lines) + "\n")
    (sweep / "2" / "config.yaml").write_text("a: [")  # the list is sufficient
    (sweep / ("9" * 12)).mkdir()  # no job of any sweep
    failed, missing = read(sweep).problems
    assert re.fullmatch(r"job 2 \(kernels.imaginable=1.0, model.alpha_max=10\).*failed.*out of luck", failed)
    assert re.match(r"job 4 \(kernels.imaginable=1.4, model.alpha_max=10\).*missing", missing)
    (sweep / "jobs.csv").write_text("folder,state\nx,done\n")
    with pytest.raises(UserError, match="jobs.csv: is damaged"):
        read(sweep)
