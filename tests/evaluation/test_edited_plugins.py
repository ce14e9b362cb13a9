"""Evaluations before and after an edit of a plugin: numbers follow the edit; an unedited plugin hits the cache."""

import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imagination.evaluation.approaches import Approach, SeenPrediction
from imagination.evaluation.prediction import Predictor
from imagination.evaluation.protocol import ModelUnderTest
from imagination.evaluation.threshold_selection import SelectedThreshold
from imagination.geometry.grid import EgoGrid
from imagination.mapping.update_rules import Max
from imagination.models.lit_unit import LitUnit
from imagination.models.losses import WeightedBCE
from imagination.views.scene_workers import ScenePool
from tests.conftest import ROOT, Command
from tests.data.test_datamodule import data
from tests.data.test_datamodule import observer as make_observer
from tests.helpers.plugin_modules import Import, edit, new_process, write
from tests.helpers.toy_evaluation import NAMES, make_model, make_protocol

SCENE = "val_0"
SELECTED = {("mine", "chair"): SelectedThreshold(0.5, 0.0, 1.0)}

RULE = {
    "rule": """
import numpy as np
from edited_plugin.shift import OFFSET

class Rule:
    def __init__(self, weight=1.0):
        self.weight = weight

    def __call__(self, old, new, count):
        return np.clip(self.weight * np.maximum(old, new) + OFFSET, 0, 1).astype(np.float32)
""",
    "shift": "OFFSET = -0.1\n",
}

UNIT = {
    "unit": """
from edited_plugin.encoder import Encoder
from imagination.models.unit import Unit

class MyUnit(Unit):
    def __init__(self, power=1.0):
        super().__init__(["chair"])
        self.power = power
        self.encoder = Encoder()

    def logits(self, rgb, depth, occupied, seen):
        return self.power * (8.0 * occupied.float() - 6.0 + self.encoder(rgb))
""",
    "encoder": """
from torch import nn
from edited_plugin.shift import OFFSET

class Encoder(nn.Module):
    channels = 1

    def forward(self, rgb):
        return rgb.float().mean(dim=(1, 2, 3), keepdim=True) / 255 + OFFSET
""",
    "shift": "OFFSET = 0.0\n",
}

ROOMS = {
    "rooms": """
from dataclasses import dataclass
from edited_plugin.sizes import WIDTH
from tests.helpers.room_source import Rooms
from tests.helpers.rooms import tiny_room

@dataclass(frozen=True)
class MyRooms(Rooms):
    def load(self, scene):
        return tiny_room(turn=0.1, size=(WIDTH, 4.0))
""",
    "sizes": "WIDTH = 5.0\n",
}


@pytest.fixture
def plugin(tmp_path: Path) -> Path:
    return tmp_path / "edited_plugin"


class Counting:
    """Predictor that counts its calls."""

    def __init__(self, predict: Any) -> None:
        self.predict, self.gives, self.fingerprint, self.calls = (
            predict,
            predict.gives,
            predict.fingerprint,
            0,
        )

    def __call__(self, views: Any, wanted: Any) -> Any:
        self.calls += 1
        return self.predict(views, wanted)


def evaluated(model: ModelUnderTest, approach: Approach) -> tuple[list[int], bool]:
    """Return the counts of a trial, and whether they came from the cache."""
    model = model._replace(predict=Counting(model.predict))
    protocol = replace(make_protocol(cell_widths=[1.5], viewpoint_sets=1), approaches={"mine": approach})
    (counts,) = protocol.evaluate(model, [SCENE], SELECTED, silent=True).counts.values()
    return counts.ravel().tolist(), model.predict.calls == 0


def with_rule(imported: Import, cache: Path) -> tuple[list[int], bool]:
    """Evaluate the rule of the plugin."""
    rule = imported("edited_plugin.rule").Rule()
    return evaluated(make_model(cache, ("chair",), count=1), Approach(SeenPrediction(), rule))


def with_unit(imported: Import, cache: Path) -> tuple[list[int], bool]:
    """Evaluate the unit of the plugin."""
    model = make_model(cache, ("chair",), count=1)
    ego = model.setting.ego
    unit = imported("edited_plugin.unit").MyUnit()
    task = LitUnit(unit, WeightedBCE(10.0, 10.0), ego, 0.5, lambda _: None, lambda _: None)  # type: ignore[arg-type, return-value]
    predictor = Predictor([task], ["chair"], list(NAMES), 8)
    return evaluated(model._replace(predict=predictor), Approach(SeenPrediction(), Max()))


def with_rooms(imported: Import, cache: Path) -> tuple[list[int], bool]:
    """Evaluate in the rooms of the plugin."""
    model = make_model(cache, ("chair",), count=1)
    rooms = imported("edited_plugin.rooms").MyRooms(1)
    pool = ScenePool(replace(model.pool.observer, source=rooms), 0)
    return evaluated(model._replace(pool=pool), Approach(SeenPrediction(), Max()))


CASES: Mapping[str, tuple[Any, Mapping[str, str], str, str, str]] = {
    "rule": (with_rule, RULE, "rule", "self.weight * np.maximum(old, new)", "0.5 * new"),
    "module that the rule imports": (with_rule, RULE, "shift", "-0.1", "-0.9"),
    "unit": (with_unit, UNIT, "unit", "- 6.0", "- 2.0"),
    "encoder": (with_unit, UNIT, "encoder", "/ 255", "/ 25"),
    "module that the encoder imports": (with_unit, UNIT, "shift", "0.0", "4.0"),
    "scene source": (with_rooms, ROOMS, "rooms", "0.1", "1.2"),
    "module that the scene source imports": (with_rooms, ROOMS, "sizes", "5.0", "6.5"),
}


@pytest.mark.parametrize("case", CASES)
def test_numbers_follow_an_edit_and_an_unedited_plugin_hits_the_cache(
    case: str, plugin: Path, tmp_path: Path
) -> None:
    run, files, module, old, new = CASES[case]

    def numbers(cache: str = "cache") -> tuple[list[int], bool]:
        with new_process(tmp_path) as imported:
            result: tuple[list[int], bool] = run(imported, tmp_path / cache)
            return result

    write(plugin, **files)
    before, cached = numbers()
    assert not cached and before[0] > 0
    assert numbers() == (before, True)
    edit(plugin / f"{module}.py", old, new)
    after, cached = numbers()
    assert not cached and after != before
    assert numbers() == (after, True) and numbers("empty") == (after, False)
    edit(plugin / f"{module}.py", new, old)
    assert numbers() == (before, True)


def test_an_edit_of_a_unit_changes_the_fingerprint_of_its_predictions(plugin: Path, tmp_path: Path) -> None:
    """Settings that are attributes count as well, in any part of the network, and objects of the plugin."""
    gain = "class Gain:\n    def __init__(self, factor):\n        self.factor = factor\n"
    write(plugin, **UNIT, gain=gain)
    with new_process(tmp_path) as imported:
        make = imported("edited_plugin.unit").MyUnit
        ego = EgoGrid.of_extent(3.7, 0.1)

        def fingerprint(power: float, **settings: Any) -> str:
            unit = make(power)
            vars(unit.encoder).update(settings)
            task = LitUnit(unit, WeightedBCE(10.0, 10.0), ego, 0.5, lambda _: None, lambda _: None)  # type: ignore[arg-type, return-value]
            return Predictor([task], ["chair"], list(NAMES), 8).fingerprint

        gains = [imported("edited_plugin.gain").Gain(factor) for factor in (2, 2, 3)]
        first, same, other = (fingerprint(1.0, gain=gain) for gain in gains)
        assert first == same != other
        assert fingerprint(1.0) == fingerprint(1.0)
        assert (
            len({fingerprint(1.0), fingerprint(2.0), fingerprint(1.0, _gain=2), fingerprint(1.0, _gain=3)})
            == 4
        )


def test_ground_truth_and_views_follow_an_edit_of_the_scene_source(plugin: Path, tmp_path: Path) -> None:
    def pixels() -> Iterator[Any]:
        with new_process(tmp_path) as imported:
            watcher = make_observer(tmp_path / "cache", imported("edited_plugin.rooms").MyRooms(1))
            yield watcher.fingerprint("train_0")
            yield watcher.ground_truth("train_0").occupied.sum()
            yield data(tmp_path / "cache", source=watcher.source).collector(2).start(0)()["depth"].sum()

    write(plugin, **ROOMS)
    before = list(pixels())
    assert list(pixels()) == before
    edit(plugin / "sizes.py", "5.0", "6.5")
    assert not np.equal(before, list(pixels())).any()


@pytest.mark.slow
def test_commands_evaluate_an_edited_plugin_again(command: Command, tmp_path: Path) -> None:
    """The evaluation at the end of a training and later ones share the cache until the plugin is edited."""
    plugin = tmp_path / "plugins" / "example"
    shutil.copytree(ROOT / "tests" / "helpers" / "example_plugin", plugin)
    results = tmp_path / "outputs" / "cache" / "evaluation_results"

    def run(name: str, *arguments: str) -> tuple[int, str]:
        done = command(name, *arguments)
        assert done.returncode == 0, done.stderr
        newest = max((tmp_path / "outputs").glob("*/*/tables/mapping.csv"), key=os.path.getmtime)
        return len(list(results.iterdir())), newest.read_text()

    ckpt = "ckpt=outputs/blind_seats/latest/checkpoints/best.ckpt"
    entries, table = run("train", "experiment=blind_seats", "scale=test", "trainer.max_epochs=1")
    assert entries > 0
    assert run("evaluate", ckpt)[0] == entries
    edit(plugin / "imagination_example" / "unit.py", "return logits", "return 3 - logits")
    more, edited = run("evaluate", ckpt)
    assert more == 2 * entries and edited != table
    assert run("evaluate", ckpt) == (more, edited)
    edit(plugin / "imagination_example" / "rooms.py", "box(0.5, 0.5, 0.8)", "box(0.9, 0.5, 0.8)")
    assert run("evaluate", ckpt)[0] == 3 * entries
    done = command("train", "resume=latest", "trainer.max_epochs=2")
    assert done.returncode == 0 and "the program has changed" in done.stderr, done.stderr
