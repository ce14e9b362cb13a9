"""Benchmarks: results of sections, unmeasured figures, and checks of the public methods."""

import inspect
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pytest
import torch

from imagination.mapping.mapper import Mapper
from imagination.mapping.update_rules import MovingAverage
from tests.benchmarks import __main__ as command
from tests.benchmarks import buffer, gpu, maps, startup
from tests.benchmarks.measure import Figure, unmeasured


def result(*figures: Figure, **about: Any) -> dict[str, Any]:
    made = {
        "day": "2026-01-01",
        "hardware": "a machine",
        "python": "3",
        "libraries": {"torch": "2"},
        "seed": 0,
    }
    made |= {"command": "python -m tests.benchmarks", "minutes": 1.0}
    return {"figures": [asdict(figure) for figure in figures], **made, **about}


def test_a_section_replaces_its_earlier_result(tmp_path: Path) -> None:
    command.write(
        tmp_path, "ground_truth", result(Figure("ground truth", 5.0, "s", 4.0, "a limit", 6.0, at_most=True))
    )
    command.write(tmp_path, "startup", result(Figure("start-up", 2.0, "s")))
    command.write(tmp_path, "ground_truth", result(Figure("ground truth", 3.0, "s"), day="2026-01-02"))
    sections = json.loads((tmp_path / "results.json").read_text())["sections"]
    assert list(sections) == ["startup", "ground_truth"]
    page = (tmp_path / "results.md").read_text()
    assert "| start-up | 2 s |" in page and "| ground truth | 3 s |" in page and "5 s" not in page
    head, _, section = page.partition("## Ground truth")
    assert "2026-01-01" in head and "2026-01-02" in section and "2026-01-01" not in section
    assert "took 2.0 minutes together" in head


def test_a_section_shows_its_provenance_where_it_differs_from_the_head(tmp_path: Path) -> None:
    figure = Figure("a", 1.0, "s", note="a note")
    command.write(tmp_path, "startup", result(figure))
    command.write(tmp_path, "maps", result(figure, replace(figure, what="b"), command="another command"))
    operators = {"bf16-mixed": [("aten::convolution", 0.5)]}
    command.write(tmp_path, "training", result(figure, operators=operators, minutes=3.0))
    page = (tmp_path / "results.md").read_text()
    head, startup, maps, training = page.split("## ")
    assert "a machine" in head and "seed 0" in head and "5.0 minutes together" in head
    assert "by `python -m tests.benchmarks`" in head and "unless a section states otherwise" in head
    assert page.count("a machine") == 1 and page.count("by `python -m tests.benchmarks`") == 1
    assert "python -m" not in startup and "Made by `another command`" in maps
    assert "3.0 minutes" in training and "- a and 1 like it: a note." in maps
    assert "bf16-mixed, profiled: 50% `aten::convolution`" in training
    command.write(tmp_path, "maps", result(figure))
    page = (tmp_path / "results.md").read_text()
    assert (
        page.count("by `python -m tests.benchmarks`") == 1
        and "by `python -m tests.benchmarks`" in page.split("## ")[0]
    )


def test_figures_of_another_machine_are_kept_if_none_is_measured(tmp_path: Path) -> None:
    command.write(tmp_path, "gpu", result(Figure("a step", 5.0, "samples/s"), hardware="a GPU"))
    command.write(tmp_path, "gpu", result(unmeasured("a step", "no GPU"), hardware="a CPU"))
    assert "| a step | 5 samples/s |" in (tmp_path / "results.md").read_text()
    command.write(tmp_path, "gpu", result(Figure("a step", 6.0, "samples/s"), unmeasured("b", "no compiler")))
    assert (
        "| a step | 6 samples/s |" in (page := (tmp_path / "results.md").read_text())
        and "no compiler" in page
    )


@pytest.mark.slow
@pytest.mark.parametrize("experiment", gpu.EXPERIMENTS.values())
@pytest.mark.parametrize("kind", gpu.KINDS)
def test_the_steps_of_the_gpu_section_train(tmp_path: Path, experiment: str, kind: str) -> None:
    step, size = gpu.training_step(
        str(tmp_path), experiment, kind, 2, "scale=test", "data.batch_size=4", device="cpu"
    )
    module = inspect.getclosurevars(step).nonlocals["module"]
    before = [weights.detach().clone() for weights in module.parameters()]
    step()
    assert size == 4
    changed = [not torch.equal(*pair) for pair in zip(before, module.parameters(), strict=True)]
    assert sum(changed) > len(changed) / 2


def test_unmeasured_sections_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "litdata", None)
    command.section("shards", str(tmp_path))
    output = json.loads(capsys.readouterr().out)
    command.write(tmp_path, "shards", {**result(), **output})
    page = (tmp_path / "results.md").read_text()
    assert "| shards | not measured |" in page and "pip install -e '.[shards]'" in page


def test_a_failed_section_keeps_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_in_process(*arguments: str) -> dict[str, Any] | None:
        if arguments[0] == "--machine":
            return {name: result()[name] for name in ("day", "hardware", "python", "libraries", "seed")}
        return None if arguments[1] == "maps" else {"figures": [asdict(Figure(arguments[1], 1.0, "s"))]}

    monkeypatch.setattr(command, "run_in_process", run_in_process)
    monkeypatch.setattr(command, "FOLDER", tmp_path)
    assert not command.main(["ground_truth", "maps", "buffer"])
    page = (tmp_path / "results.md").read_text()
    assert "| maps | not measured |" in page and "failed" in page and "| buffer | 1 s |" in page
    assert command.main(["maps"]) is False and "| buffer | 1 s |" in (tmp_path / "results.md").read_text()


def test_a_figure_without_a_value_has_no_ratio_and_meets_no_target() -> None:
    figure = replace(unmeasured("a", "no compiler"), target=1.0)
    assert figure.met is None and figure.ratio is None


@pytest.mark.parametrize("cells", [1001, 8001])
def test_views_are_spread_over_the_map_and_inside_it(cells: int) -> None:
    """Registration into a large map then accesses all of its memory."""
    values, _ = maps.view_evidence()
    mapper = Mapper(maps.grid_of(cells), maps.EGO, maps.NAMES, MovingAverage(0.9))
    poses = maps.spread_poses(64, cells)
    assert not any(mapper.outside(np.ones_like(values, bool), pose) for pose in poses)
    side = cells * maps.RESOLUTION - 2 * 5.9  # the corners of a view are 5.84 m away
    assert min(np.ptp([pose.x for pose in poses]), np.ptp([pose.y for pose in poses])) > 0.9 * side


@pytest.mark.slow
def test_public_methods_give_our_maps() -> None:
    """The checks of `make bench` before timing."""
    maps.check_padded(views=3)
    maps.check_splatted()


@pytest.fixture
def single_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make benchmarks call each function once."""

    def once(functions: Mapping[str, Callable[[], object]], *_: object) -> dict[str, float]:
        times = {}
        for name, function in functions.items():
            start = perf_counter()
            function()
            times[name] = perf_counter() - start
        return times

    for module in (buffer, maps, startup):
        monkeypatch.setattr(module, "medians", once)


@pytest.mark.slow
@pytest.mark.usefixtures("single_call")
def test_quick_sections_measure_positive_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        maps, "grid_of", lambda cells, grid_of=maps.grid_of: grid_of(min(cells, 1001))
    )  # less memory
    depth, labels = maps.example_view()
    for figure in (
        *buffer.run(str(tmp_path)),
        *startup.run(str(tmp_path)),
        maps.projection(depth, labels),
        maps.whole_step(depth, labels),
        maps.frame(depth),
    ):
        assert figure.value is not None and figure.value > 0 and (figure.limit or 0) > 0, figure.what


@pytest.mark.slow
@pytest.mark.parametrize("name", command.SECTIONS)
def test_every_section_runs(tmp_path: Path, name: str) -> None:
    """As `make bench` does; a section without its extra reports that."""
    output = command.run_in_process("--section", name, str(tmp_path))
    assert output is not None and output["figures"]
