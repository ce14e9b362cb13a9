"""Sweeps: swept values are found, failed and missing jobs are reported, and the rest is shown."""

import json
import re
import shutil
from itertools import product
from pathlib import Path

import pytest
import yaml

from imagination.report import read
from imagination.reporting.load_sweep import MAX_JOBS, Multirun, grid
from imagination.utils.errors import UserError
from tests.helpers.run_folders import APPROACHES, CATEGORIES, WIDTHS, make_folder

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
    (table,) = [table for section in content.sections for table in section.layouts]
    assert [len(lines) for _, lines in table.blocks] == [6, 6, 6, 6]
    assert table.blocks[0][1][0].name == "kernels.imaginable=0.6, model.alpha_max=10"
    first = read(sweep / "0").sections[0].layouts[0].blocks[0][1][0].cells[0]
    assert first and table.blocks[0][1][0].cells[0] == first._replace(
        strong=table.blocks[0][1][0].cells[0].strong
    )  # type: ignore[union-attr]
    stems = [drawing.stem for section in content.sections for drawing in section.drawings]
    keys = "kernels_imaginable", "model_alpha_max"
    assert stems == [f"ablation_{key}_{of}" for key in keys for of in ("chair", "bed")]


def validated(sweep: Path, number: int, iou: float) -> None:
    """Write a job's IoU on validation scenes into its mapping.csv."""
    rows = [
        f"{approach},{category},{width},0.1,0.1,{iou}"
        for approach, category, width in product(APPROACHES, CATEGORIES, WIDTHS)
    ]
    head = "approach,category,cell_width,iou_seen,iou_unseen,iou_val"
    (sweep / str(number) / "tables" / "mapping.csv").write_text("\n".join([head, *rows]) + "\n")


def strong(sweep: Path) -> set[int]:
    (table,) = [table for section in read(sweep).sections for table in section.layouts]
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
    table = sweep / "2" / "tables" / "trials.csv"
    lines = table.read_text().splitlines()
    table.write_text(
        "\n".join([lines[0], *(f"{line}0" for line in lines[1:])]) + "\n"
    )  # ten times the ground truth
    assert strong(sweep) == set()
    (layout,) = [layout for section in read(sweep).sections for layout in section.layouts]
    assert "different ground truth" in layout.note


def test_swept_values_are_found_in_configs_without_overrides(sweep: Path) -> None:
    """As in evaluations; of two keys that vary together one is named."""
    (sweep / "multirun.yaml").unlink()
    command = "python -m imagination.train +experiment=made +hparams_search=optuna"
    where = sweep / "0" / "tables" / "provenance.json"
    where.write_text(json.dumps({"command": "python -m somebody.s worker"}))
    assert read(sweep).commands == [f"python -m imagination.report folder={sweep}"]
    where.write_text(json.dumps({"command": f"{command} hydra.sweep.dir=old"}))
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
    shutil.rmtree(sweep / "1" / "tables")
    shutil.rmtree(sweep / "1" / "maps")
    (sweep / "1" / "run.log").write_text(
        "INFO\nERROR root: The run failed\nTraceback …\nRuntimeError: out of luck\n"
    )
    (sweep / "2" / "config.yaml").write_text("a: [")
    for name in ("tables", "maps"):
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
    (table,) = [table for section in content.sections for table in section.layouts]
    assert [line.name for line in table.blocks[0][1]] == [
        "kernels.imaginable=0.6, model.alpha_max=10", "kernels.imaginable=1.4, model.alpha_max=10",
    ]  # fmt: skip
    states = [row["state"] for section in content.sections for plain in section.plain for row in plain.rows]
    assert states == ["complete", "failed", "failed", "unfinished", "complete", "missing"]


def test_a_sweep_over_cell_widths_is_drawn_over_all_of_each(tmp_path: Path) -> None:
    folder = tmp_path / "multirun"
    for number, width in enumerate((3.0, 2.0)):
        job = make_folder(folder / str(number), choices=[f"evaluation.cell_widths=[{width}]"])
        table = job / "tables" / "trials.csv"
        head, *lines = table.read_text().splitlines()
        table.write_text("\n".join([head, *(line for line in lines if f",{width:g},test" in line)]) + "\n")
        config = yaml.safe_load((job / "config.yaml").read_text())
        config["evaluation"]["cell_widths"] = [width]
        (job / "config.yaml").write_text(yaml.safe_dump(config))
    content = read(folder)
    assert content.problems == []
    (drawing, _) = content.sections[1].drawings
    axes = drawing.draw().axes
    assert [axis.get_title() for axis in axes] == ["all cell widths together"]
    assert axes[0].get_xlabel() == "evaluation.cell_widths"


def test_jobs_without_a_common_category_are_drawn(tmp_path: Path) -> None:
    """A unit of chairs and a segmentation network of chairs and beds, with two seeds each."""
    for number, (experiment, seed) in enumerate((e, s) for e in ("chair_unet", "hrnet") for s in (0, 1)):
        folder = make_folder(
            tmp_path / str(number), number, seed=seed, choices=[f"+experiment={experiment}", f"seed={seed}"]
        )
        table = folder / "tables" / "trials.csv"
        head, *lines = table.read_text().splitlines()
        left = ",bed," if experiment == "chair_unet" else "imagination,"
        table.write_text("\n".join([head, *(line for line in lines if left not in line)]) + "\n")
    drawn = [drawing for section in read(tmp_path).sections for drawing in section.drawings]
    assert [drawing.stem for drawing in drawn] == ["ablation_experiment_chair", "ablation_seed_chair"]
    for drawing in drawn:
        drawing.draw()


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
