"""What a folder lacks is told and the rest is read; what is damaged is named."""

from pathlib import Path

import pytest

from imagination.errors import UserError
from imagination.report import read
from imagination.reporting.results import Results
from tests.reporting.folders import make_config, make_folder


def problems(folder: Path) -> str:
    return "\n".join(read(folder).problems)


def test_missing_runs_are_told(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    table = folder / "tables" / "runs.csv"
    kept = [
        line
        for line in table.read_text().splitlines()
        if not line.startswith("imagination,chair,2,test_0001")
    ]
    table.write_text("\n".join(line for line in kept if not line.startswith("mine,bed,3")) + "\n")
    told = problems(folder)
    assert (
        "imagination, chair, cell width 2 m: 2 of 6 runs missing (test_0001 set 0, test_0001 set 1)" in told
    )
    assert "mine, bed, cell width 3 m: 4 of 4 runs missing (test_0000 set 0" in told
    assert len(told.splitlines()) == 2
    stems = {table.stem for section in read(folder).sections for table in section.layouts}
    assert "iou" in stems


def test_a_category_without_runs_is_told(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run", unit_categories=["chair", "bed", "sofa"])
    assert problems(folder) == "sofa: no run of any approach"


def test_without_its_table_an_evaluation_is_counted_from_the_maps_so_far(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    whole = Results(folder).counts
    (folder / "tables" / "runs.csv").unlink()
    (folder / "maps" / "test_0002_2m_1.npz").unlink()
    results = Results(folder)
    for key, runs in whole.items():
        for run, counts in results.counts[key].items():
            assert (counts == runs[run]).all()
    told = "\n".join(results.problems)
    assert "counted again from the maps" in told and "test_0002 set 1" in told


@pytest.mark.parametrize(
    "name", ["tables/runs.csv", "tables/thresholds.csv", "tables/provenance.json", "maps/test_0000_3m_0.npz",
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
    assert any(name in problem and "damaged" in problem for problem in content.problems), content.problems
    assert any(section.layouts for section in content.sections)


def test_damaged_curves_are_named(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "run")
    (folder / "tensorboard").mkdir()
    (folder / "tensorboard" / "events.out.tfevents.1.host.1.0").write_bytes(b"nothing that TensorBoard knows")
    assert "tensorboard" in problems(folder) and "damaged" in problems(folder)


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="there is no such folder"):
        read(tmp_path / "nothing")
    with pytest.raises(UserError, match="expected the folder of a run, an evaluation or a sweep"):
        read(tmp_path)
    (tmp_path / "config.yaml").write_text("a: [1")
    with pytest.raises(UserError, match=r"config .*config.yaml: is damaged"):
        read(tmp_path)
    (tmp_path / "config.yaml").write_text("just text")
    with pytest.raises(UserError, match="got str"):
        read(tmp_path)


def test_a_run_that_never_evaluated_is_shown_as_that(tmp_path: Path) -> None:
    import yaml

    (tmp_path / "config.yaml").write_text(yaml.safe_dump(make_config()))
    content = read(tmp_path)
    assert "runs.csv is missing: the evaluation has not ended" in content.problems[0]
    assert content.sections == [] and "+experiment=made" in content.commands[0]
