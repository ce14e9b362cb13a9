"""Missing and damaged parts of a folder are reported and the rest is read."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.event_file_writer import EventFileWriter

from imagination.evaluation.record_files import COLUMNS, PIXELS, TRIAL_KEY, write_scenes
from imagination.report import read
from imagination.reporting.html import drawings
from imagination.reporting.load_run import MAX_RESAMPLES, Results
from imagination.utils.errors import UserError
from imagination.utils.tabular import csv_text
from tests.helpers.run_folders import make_config, make_folder, read_about, set_command, write_about


def problems(folder: Path) -> str:
    return "\n".join(read(folder).problems)


def problems_of_files(folder: Path) -> list[str]:
    """Return the problems of the files of a folder without making a report."""
    results = Results(folder)
    assert results.trials is not None and results.maps is not None and results.view_counts is not None
    assert results.single_views is not None
    return results.all_problems


def test_missing_trials_are_reported(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    table = folder / "records" / "trials.csv"
    kept = [
        line
        for line in table.read_text().splitlines()
        if not line.startswith(("test,imagination,chair,2,test_0001", "test,mine,bed,3"))
    ]
    table.write_text("\n".join(kept) + "\n")
    first, second = problems(folder).splitlines()
    assert re.search(r"imagination, chair, .*2 m: 2 of 12 .*test_0001 set 0, test_0001 set 1", first)
    assert re.search(r"mine, bed, .*3 m: 10 of 10 .*test_0000 set 0", second)
    stems = {table.stem for section in read(folder).sections for table in section.layouts}
    assert "iou" in stems


def test_a_category_without_trials_is_reported(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run", unit_categories=["chair", "bed", "sofa"])
    assert problems(folder).startswith("sofa: ") and "\n" not in problems(folder)


def test_without_its_records_an_evaluation_is_counted_from_the_maps_so_far(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    whole = Results(folder).trials.set_index(list(TRIAL_KEY))
    (folder / "records" / "trials.csv").unlink()
    (folder / "maps" / "test_0002_2m_1.npz").unlink()
    results = Results(folder)
    counted = results.trials.set_index(list(TRIAL_KEY))
    assert len(counted) == len(whole) - 8
    columns = list(PIXELS)
    assert (counted[columns] == whole.loc[counted.index, columns]).all(axis=None)
    messages = "\n".join(results.problems)
    assert "records/ is incomplete" in messages and "maps" in messages and "test_0002 set 1" in messages


@pytest.mark.parametrize(
    "name", ["records/trials.csv", "records/thresholds.csv", "records/evaluation.json", "maps/test_0000_3m_0.npz",
             "single_views.npz", "tables/ego.csv"],
)  # fmt: skip
def test_damaged_files_are_named_and_the_rest_is_shown(tmp_path: Path, name: str) -> None:
    folder = make_folder(tmp_path / "run")
    path = folder / name
    if path.suffix == ".npz":
        path.write_bytes(path.read_bytes()[:-300])
    else:
        path.write_text("a,b\n1\n" if name.endswith("ego.csv") else "approach,cells\nx,\x00\n{")
    content = read(folder)
    assert any(Path(name).name in problem and "damaged" in problem for problem in content.problems), (
        content.problems
    )
    assert any(section.layouts for section in content.sections)


@pytest.mark.parametrize("name", ["maps/test_0000_3m_0.npz", "single_views.npz"])
def test_a_single_wrong_bit_is_named(tmp_path: Path, name: str) -> None:
    """In compressed data zlib detects some of them and raises errors of various types."""
    folder = make_folder(tmp_path / "run")
    whole = (folder / name).read_bytes()
    named = 0
    for place in range(60, len(whole), 1009):  # in headers of the archive some change nothing
        (folder / name).write_bytes(whole[:place] + bytes([whole[place] ^ 8]) + whole[place + 1 :])
        results = Results(folder)
        complete = len(results.maps) == 24 and bool(results.single_views[0])
        named += f"{name} is damaged" in "".join(results.problems)
        assert complete != bool(results.problems)
    assert named > len(whole) // 1009 / 2


@pytest.mark.parametrize(
    ("name", "array", "wrong", "message"),
    [
        ("maps/test_0000_3m_0.npz", "truth", np.zeros((2, 30, 41), bool), "truth: got bool of shape (2, 30, 41)"),
        ("maps/test_0000_3m_0.npz", "level", np.zeros((4, 2, 30, 40)), "level: got float64"),
        ("maps/test_0000_3m_0.npz", "approaches", np.array(["one"]), "level: got uint8 of shape (4, 2, 30, 40)"),
        ("maps/test_0000_3m_0.npz", "resolution", np.array(0.0), "resolution: got 0.0"),
        ("maps/test_0000_3m_0.npz", "poses", np.full((3, 3), np.nan), "poses: got"),
        ("maps/test_0000_3m_0.npz", "poses", np.full((3, 3), 1e9), "poses: got"),
        ("maps/test_0000_3m_0.npz", "cell_width", np.array(np.nan), "cell_width: got nan"),
        ("maps/test_0000_3m_0.npz", "level", np.full((4, 2, 30, 40), 100, np.uint8), "level: got 100"),
        ("maps/test_0000_3m_0.npz", "categories", np.array([b"chair", b"bed"]), "expected each name once"),
        ("maps/test_0000_3m_0.npz", "categories", np.array(["chair", "chair"]), "expected each name once"),
        ("single_views.npz", "category", np.arange(6), "expected names"),
        ("maps/test_0000_3m_0.npz", "more", np.zeros(1), "unexpected keyword argument 'more'"),
        ("single_views.npz", "seen", np.zeros((6, 21, 20), bool), "seen: got bool of shape (21, 20)"),
        ("single_views.npz", "rgb", np.zeros((6, 16, 16, 4), np.uint8), "rgb: got uint8 of shape (16, 16, 4)"),
        ("single_views.npz", "predicted", np.zeros((6, 4, 21, 21)), "seg_gt: got float64"),
        ("single_views.npz", "approaches", np.array([], np.str_), "argument 2 is longer"),
        ("single_views.npz", "resolution", np.array(np.inf), "resolution: got inf"),
    ],
)  # fmt: skip
def test_arrays_that_do_not_fit_are_named(
    tmp_path: Path, name: str, array: str, wrong: np.ndarray, message: str
) -> None:
    folder = make_folder(tmp_path / "run")
    with np.load(folder / name) as file:
        arrays = dict(file)
    np.savez_compressed(folder / name, **{**arrays, array: wrong})
    (problem,) = {line for line in problems_of_files(folder) if line.startswith(f"{name} is damaged")}
    assert message in problem


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("trials.csv", "seg_gt,chair,3,", "seg_gt,chair,nan,", "cell_width: got nan"),
        ("trials.csv", "seg_gt,chair,3,", "seg_gt,chair,0.5e9,", "cell_width: got 500000000.0"),
        ("trials.csv", ",70\n", f",{10**30}\n", f"gt_pixels_shuffled: got {10**30}"),
        ("trials.csv", ",70\n", ",-70\n", "gt_pixels_shuffled: got -70"),
        ("trials.csv", ",70\n", ",1\n", "correct_shuffled of 1 ground-truth pixels"),
        ("trials.csv", "test_0000,1", "test_0000,0", "an earlier row has as well"),
        ("trials.csv", "gt_pixels_seen", "gt", "got no column gt_pixels_seen"),
        ("trials.csv", "", "", "got no trials"),
        ("thresholds.csv", ",150\n", ",50\n", "50 ground-truth cells"),
    ],
)
def test_invalid_counts_are_named(tmp_path: Path, name: str, old: str, new: str, message: str) -> None:
    folder = make_folder(tmp_path / "run")
    table = folder / "records" / name
    assert old in table.read_text()
    table.write_text(table.read_text().replace(old, new, 1) if old else "")
    (problem,) = {line for line in problems_of_files(folder) if "is damaged" in line}
    assert name in problem and message in problem


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 0}, "records of version 0, expected 1"),
        ({"seconds": "long"}, "seconds: got 'long', expected a number"),
        ({"seconds": True}, "seconds: got True"),
        ({"resolution": 0}, "resolution: got 0"),
        ({"protocol": {}}, "protocol.seed: got None"),
        ({"approaches": {"mine": "Max()"}}, "mine: got 'Max()', expected dict"),
        ({"selected": [{"approach": 1}]}, "selected.approach: got 1"),
        ({"networks": [{"a": "b"}, {"c": "d"}]}, "networks: got the columns c"),
        ({"credits": [{"author": "x"}]}, "credits: got the columns author"),
        ({"provenance": {"date": 5}}, "provenance: got 5, expected str"),
        ({"left_out": {"chair": []}}, "left_out: got []"),
    ],
)
def test_invalid_records_are_named(tmp_path: Path, change: dict[str, object], message: str) -> None:
    folder = make_folder(tmp_path / "run")
    write_about(folder, {**read_about(folder), **change})
    (problem,) = {line for line in problems_of_files(folder) if line.startswith("records/ is ")}
    assert ("of another version" in problem) == ("version" in change)
    assert message in problem and str(folder / "records" / "evaluation.json") in problem


@pytest.mark.parametrize("text", ["[1]", f'{{"seconds": {10**400}}}', "[" * 100_000])
def test_records_that_no_evaluation_writes_are_named(tmp_path: Path, text: str) -> None:
    folder = make_folder(tmp_path / "run")
    (folder / "records" / "evaluation.json").write_text(text)
    (problem,) = {line for line in problems_of_files(folder) if line.startswith("records/ is ")}
    assert "evaluation.json" in problem


def test_text_of_records_returns_as_it_was(tmp_path: Path) -> None:
    """A spreadsheet program would run a scene with such a name as a formula."""
    folder = make_folder(tmp_path / "run")
    names = {
        "test_0000": "=cmd|' /C calc'!A0",
        "test_0001": "-1+1",
        "test_0002": "'quoted",
        "test_0003": "@x",
    }
    table = folder / "records" / "trials.csv"
    rows = [line.split(",") for line in table.read_text().splitlines()]
    text = csv_text([[names.get(cell, cell) for cell in row] for row in rows])
    table.write_text(text)
    assert ",'=cmd" in text and ",'-1+1" in text and ",''quoted" in text and ",=" not in text
    assert set(Results(folder).trials["scene"]) >= set(names.values())
    assert list(rows[0]) == COLUMNS


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"evaluation": 5}, "evaluation is damaged: got 5, expected dict"),
        (
            {"evaluation": {"cell_widths": [3.0, "wide"]}},
            "evaluation.cell_widths: got 'wide', expected a number",
        ),
        ({"evaluation": {"resamples": 0}}, r"evaluation.resamples: got 0, expected a number in \[1"),
        ({"evaluation": {"viewpoint_sets": 10**12}}, "evaluation.viewpoint_sets: got 1000000000000"),
        ({"ego": {"resolution": -1}}, "ego.resolution: got -1"),
        ({"data": {"scenes": "rooms"}}, "data.scenes is damaged: got 'rooms'"),
        ({"unit_categories": "chair"}, "unit_categories is damaged: got 'chair', expected list"),
        (
            {"unit_categories": ["chair", {"bed": 1}]},
            "unit_categories is damaged: got {'bed': 1}, expected names",
        ),
        ({"ckpt": 3}, "ckpt is damaged: got 3, expected str or list"),
        ({"more": {5: "five"}}, "got the key 5, expected text"),
    ],
)
def test_an_invalid_config_is_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    folder = make_folder(tmp_path / "run", **changes)
    with pytest.raises(UserError, match=message):
        read(folder)


@pytest.mark.parametrize(
    "text", ["a: &b [*b]", "a: &b [1]\nc: [*b, *b]", "a: 2026-13-45", "a: " + "[" * 5000]
)
def test_yaml_that_no_run_writes_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(UserError, match=r"config\.yaml: cannot be read"):
        read(tmp_path)


def test_more_resamples_than_an_interval_needs_are_not_drawn(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    about = read_about(folder)
    write_about(folder, {**about, "protocol": {**about["protocol"], "resamples": 10**9}})
    assert Results(folder).bootstrap.resamples == MAX_RESAMPLES


def test_damaged_curves_are_named(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    (folder / "tensorboard").mkdir()
    (folder / "tensorboard" / "events.out.tfevents.1.host.1.0").write_bytes(b"nothing that TensorBoard knows")
    assert "tensorboard" in problems(folder) and "damaged" in problems(folder)


def log(folder: Path, **curves: list[float]) -> None:
    """Write a TensorBoard file of curves with a value every ten steps; __ in names stands for /."""
    writer = EventFileWriter(str(folder))
    for name, values in curves.items():
        for place, value in enumerate(values):
            summary = Summary(value=[Summary.Value(tag=name.replace("__", "/"), simple_value=value)])
            writer.add_event(Event(step=10 * place, wall_time=float(place), summary=summary))
    writer.close()


def test_an_evaluation_shows_how_its_networks_were_trained(tmp_path: Path) -> None:
    """Commands and curves of the existing runs, with separate charts for units and segmentation networks."""
    paths = []
    for name, predicts, scores in (
        ("chair_unet", "maps", [0.25, 0.5]), ("bed_unet", "maps", [0.5]), ("hrnet", "images", [0.75]), ("gone", "", []),
    ):  # fmt: skip
        run = tmp_path / name / "run"
        paths.append(str(run / "checkpoints" / "best.ckpt"))
        if scores:
            log(run / "tensorboard", train__loss=[3.0, 2.0, 1.0], val__iou=scores)
            config = {"name": name, "choices": [f"+experiment={name}"], "model": {"predicts": predicts}}
            (run / "config.yaml").write_text(yaml.safe_dump(config))
    folder = make_folder(tmp_path / "study", ckpt=paths, choices=[])
    evaluated = "python -m imagination.evaluate +study=paper ckpt=[…]"
    set_command(folder, evaluated)
    content = read(folder)
    assert content.problems == []
    assert content.commands == [
        *(f"python -m imagination.train +experiment={name}" for name in ("chair_unet", "bed_unet", "hrnet")),
        evaluated,
        f"python -m imagination.report folder={folder}",
    ]
    charts = {drawing.stem: drawing for drawing in drawings(content) if drawing.stem.startswith("curve_")}
    assert set(charts) == {f"curve_{name}_{kind}" for name in ("loss", "iou") for kind in ("maps", "images")}
    lines = {line.get_label(): line for line in charts["curve_iou_maps"].draw().axes[0].lines}
    assert set(lines) == {"chair_unet", "bed_unet"}
    assert lines["chair_unet"].get_xdata().tolist() == [0, 10]
    assert lines["chair_unet"].get_ydata().tolist() == [0.25, 0.5]
    (folder / "config.yaml").write_text(yaml.safe_dump(make_config(ckpt=paths[2], choices=[])))
    assert read(folder).commands[0] == "python -m imagination.train +experiment=hrnet"


@pytest.mark.parametrize(
    ("given", "again"),
    [
        (
            "+experiment=made trainer.max_epochs=3",
            "+experiment=made trainer.max_epochs=3",
        ),  # the recorded command
        ("resume=latest", "+experiment=made"),
        ("ckpt_path=made/last.ckpt", "+experiment=made"),
    ],
)
def test_a_training_is_reproduced_with_its_first_command(tmp_path: Path, given: str, again: str) -> None:
    folder = make_folder(tmp_path / "run", choices=["+experiment=made"])
    command = f"python -m imagination.train {given}"
    set_command(folder, command)
    report = f"python -m imagination.report folder={folder}"
    assert read(folder).commands == [f"python -m imagination.train {again}", report]
    (tmp_path / "jobs.csv").write_text("")  # a sweep's job: its overrides, not the command of the sweep
    assert read(folder).commands == ["python -m imagination.train +experiment=made", report]


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"folder: got .*nothing"):
        read(tmp_path / "nothing")
    with pytest.raises(UserError, match=r"folder: got .*expected"):
        read(tmp_path)
    (tmp_path / "config.yaml").write_text("a: [1")
    with pytest.raises(UserError, match=r"config.yaml: cannot be read"):
        read(tmp_path)
    (tmp_path / "config.yaml").write_text("just text")
    with pytest.raises(UserError, match="got str"):
        read(tmp_path)


def test_a_run_that_never_evaluated_is_shown_as_that(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(make_config()))
    content = read(tmp_path)
    assert "records/ is incomplete" in content.problems[0]
    assert content.sections == [] and "+experiment=made" in content.commands[0]


def test_an_interrupted_evaluation_reports_its_missing_scenes(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    (folder / "records" / "trials.csv").unlink()
    write_scenes(folder, [f"test_{number:04d}" for number in range(8)])
    assert problems(folder).endswith("6 of 8 scenes; missing: test_0006, test_0007")
    assert dict(read(folder).facts)["Scenes"] == "Rooms, 6 of the test split"


@pytest.mark.slow
@pytest.mark.parametrize("left", ["test_0001_2m_0.npz", "test_0001_3m_1.npz"])
def test_whatever_maps_are_left_are_drawn(tmp_path: Path, left: str) -> None:
    folder = make_folder(tmp_path / "run")
    for path in (folder / "maps").iterdir():
        if path.name != left:
            path.unlink()
    content = read(folder)
    (problem,) = content.problems
    assert problem.startswith("maps/: ") and "23 of 24" in problem
    assert problem.endswith("(test_0000 3 m set 0, test_0000 3 m set 1, test_0001 3 m set 0, …)")
    for drawing in drawings(content):
        drawing.draw()
