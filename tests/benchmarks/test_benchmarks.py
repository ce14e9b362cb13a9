"""What benchmarks write: a section at a time, with what could not be measured; what scaling concludes from them."""

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


def test_sections_join_those_that_are_there(tmp_path: Path) -> None:
    command.write(tmp_path, "truth", result(Figure("truth", 5.0, "s", 4.0, "a limit", 6.0, at_most=True)))
    command.write(tmp_path, "startup", result(Figure("start-up", 2.0, "s")))
    command.write(tmp_path, "truth", result(Figure("truth", 3.0, "s"), day="2026-01-02"))
    sections = json.loads((tmp_path / "results.json").read_text())["sections"]
    assert list(sections) == ["startup", "truth"]
    page = (tmp_path / "results.md").read_text()
    assert "| start-up | 2 s |" in page and "| truth | 3 s |" in page and "5 s" not in page
    first, _, truth = page.partition("## Truth")
    assert "2026-01-01" in first and "2026-01-02" in truth and "2026-01-01" not in truth
    assert "took 2.0 minutes together" in first


def test_each_section_tells_what_it_alone_was_made_with(tmp_path: Path) -> None:
    figure = Figure("a", 1.0, "s", note="a note")
    command.write(tmp_path, "startup", result(figure))
    command.write(tmp_path, "maps", result(figure, replace(figure, what="b"), command="another command"))
    operators = {"bf16-mixed": [("aten::convolution", 0.5)]}
    command.write(tmp_path, "training", result(figure, operators=operators, minutes=3.0))
    page = (tmp_path / "results.md").read_text()
    head, startup, maps, training = page.split("## ")
    assert "a machine" in head and "seed 0" in head and "5.0 minutes together" in head
    assert "by `python -m tests.benchmarks`" in head and "unless a section says otherwise" in head
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


def test_figures_of_another_machine_stay_where_there_are_none_here(tmp_path: Path) -> None:
    command.write(tmp_path, "gpu", result(Figure("a step", 5.0, "samples/s"), hardware="a GPU"))
    command.write(tmp_path, "gpu", result(unmeasured("a step", "no GPU"), hardware="a CPU"))
    assert "| a step | 5 samples/s |" in (tmp_path / "results.md").read_text()
    command.write(tmp_path, "gpu", result(Figure("a step", 6.0, "samples/s"), unmeasured("b", "no compiler")))
    assert (
        "| a step | 6 samples/s |" in (page := (tmp_path / "results.md").read_text())
        and "no compiler" in page
    )


@pytest.mark.parametrize("experiment", gpu.EXPERIMENTS.values())
@pytest.mark.parametrize("kind", gpu.KINDS)
def test_a_gpus_steps_train(tmp_path: Path, experiment: str, kind: str) -> None:
    step, size = gpu.training_step(
        str(tmp_path), experiment, kind, 2, "scale=test", "scale.batch_size=4", device="cpu"
    )
    trained = inspect.getclosurevars(step).nonlocals["module"]
    before = [weights.detach().clone() for weights in trained.parameters()]
    step()
    assert size == 4
    changed = [not torch.equal(*pair) for pair in zip(before, trained.parameters(), strict=True)]
    assert sum(changed) > len(changed) / 2


def test_what_is_not_measured_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "litdata", None)
    command.section("shards", str(tmp_path))
    told = json.loads(capsys.readouterr().out)
    command.write(tmp_path, "shards", {**result(), **told})
    page = (tmp_path / "results.md").read_text()
    assert "| shards | not measured |" in page and "pip install 'imagination[shards]'" in page


def test_a_section_that_fails_leaves_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def inside(*words: str) -> dict[str, Any] | None:
        if words[0] == "--machine":
            return {name: result()[name] for name in ("day", "hardware", "python", "libraries", "seed")}
        return None if words[1] == "maps" else {"figures": [asdict(Figure(words[1], 1.0, "s"))]}

    monkeypatch.setattr(command, "inside", inside)
    monkeypatch.setattr(command, "FOLDER", tmp_path)
    assert not command.main(["truth", "maps", "buffer"])
    page = (tmp_path / "results.md").read_text()
    assert "| maps | not measured |" in page and "it failed" in page and "| buffer | 1 s |" in page
    assert command.main(["maps"]) is False and "| buffer | 1 s |" in (tmp_path / "results.md").read_text()


def test_a_figure_without_a_value_meets_nothing() -> None:
    figure = replace(unmeasured("a", "no compiler"), target=1.0)
    assert figure.met is None and figure.ratio is None


@pytest.mark.parametrize("cells", [1001, 8001])
def test_views_are_spread_over_the_map_and_lie_inside(cells: int) -> None:
    """So that a large map's registration touches as much memory as it has."""
    values, _ = maps.statement()
    mapper = Mapper(maps.grid_of(cells), maps.EGO, maps.NAMES, MovingAverage(0.9))
    places = maps.places(64, cells)
    assert not any(mapper.outside(np.ones_like(values, bool), pose) for pose in places)
    side = cells * maps.RESOLUTION - 2 * 5.9  # a view's corners are 5.84 m away
    assert min(np.ptp([pose.x for pose in places]), np.ptp([pose.y for pose in places])) > 0.9 * side


def test_the_ways_of_others_give_our_maps() -> None:
    """What `make bench` checks before it times them."""
    maps.check_padded(views=3)
    maps.check_splatted()


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Benchmarks that call everything once."""

    def once(functions: Mapping[str, Callable[[], object]], *_: object) -> dict[str, float]:
        times = {}
        for name, function in functions.items():
            start = perf_counter()
            function()
            times[name] = perf_counter() - start
        return times

    for module in (buffer, maps, startup):
        monkeypatch.setattr(module, "medians", once)


@pytest.mark.usefixtures("hurried")
def test_quick_sections_measure_what_they_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "grid_of", lambda cells, of=maps.grid_of: of(min(cells, 1001)))  # less memory
    depth, labels = maps.a_view()
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
    """As `make bench` does; those that need an extra which is not there say so."""
    found = command.inside("--section", name, str(tmp_path))
    assert found is not None and found["figures"]
