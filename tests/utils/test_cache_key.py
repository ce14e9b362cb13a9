"""Descriptions of objects in keys: different objects have different descriptions, or are refused."""

import json
import math
import pickle
import threading
from collections.abc import Callable
from dataclasses import InitVar, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from imagination.evaluation.approaches import Approach, SeenPrediction
from imagination.mapping.update_rules import Max, MovingAverage
from imagination.scenes.categories import Category, CategoryTable
from imagination.scenes.procedural.furniture.procedural_furniture import ProceduralFurniture
from imagination.scenes.procedural.source import ProceduralHomes
from imagination.utils.cache_key import as_plain, plugin_code
from imagination.utils.errors import UserError
from tests.helpers.plugin_modules import edit, new_process, write


class Gain:
    """Rule that is no dataclass."""

    def __init__(self, gain: float) -> None:
        self._gain = gain


class OtherGain(Gain):
    """Rule with the same attributes."""


class Slots:
    __slots__ = ("gain",)

    def __init__(self, gain: float) -> None:
        self.gain = gain


class Tuple(NamedTuple):
    gain: float


class OtherTuple(NamedTuple):
    gain: float


@dataclass(frozen=True)
class Data:
    gain: float
    used: list[int] = field(default_factory=list, init=False)


@dataclass
class Derived:
    gain: InitVar[float]

    def __post_init__(self, gain: float) -> None:
        self._doubled = 2 * gain


def scaled(value: float, gain: float) -> float:
    return gain * value


DIFFERENT: list[Callable[[], Any]] = [
    lambda: Gain(1.0), lambda: Gain(2.0), lambda: OtherGain(1.0), lambda: Slots(1.0), lambda: Slots(2.0),
    lambda: Tuple(1.0), lambda: Tuple(2.0), lambda: OtherTuple(1.0), lambda: Data(1.0), lambda: Data(2.0),
    lambda: Derived(1.0), lambda: Derived(2.0), lambda: partial(scaled, gain=1.0), lambda: partial(scaled, gain=2.0),
    lambda: scaled, lambda: math.floor, lambda: Gain, lambda: Gain([1, 2]), lambda: Gain({1, 3}),
    lambda: Gain((MovingAverage(0.5), Max())), lambda: Gain((MovingAverage(0.6), Max())),
    lambda: np.arange(3), lambda: np.arange(4), lambda: np.arange(3.0), lambda: np.float32(1),
    lambda: torch.arange(3), lambda: torch.arange(4), lambda: b"1", lambda: Path("a"), lambda: Path("b"),
    lambda: None, lambda: 1.5, lambda: "1.5", lambda: [1.5], lambda: {"a": 1.5}, lambda: float("nan"),
]  # fmt: skip


def text(value: Any) -> str:
    return json.dumps(as_plain(value), sort_keys=True)


def test_equal_objects_have_equal_and_different_ones_different_descriptions() -> None:
    assert [text(make()) for make in DIFFERENT] == [text(make()) for make in DIFFERENT]
    assert len({text(make()) for make in DIFFERENT}) == len(DIFFERENT)
    assert text(pickle.loads(pickle.dumps(Gain(1.0)))) == text(Gain(1.0))


def test_what_a_dataclass_computes_is_not_described() -> None:
    used = Data(1.0)
    used.used.append(1)
    assert text(used) == text(Data(1.0))


def test_classes_of_the_core_are_described_without_code() -> None:
    assert as_plain(Approach(SeenPrediction(), MovingAverage(0.5))) == {
        "class": "imagination.evaluation.approaches.Approach",
        "evidence": {"class": "imagination.evaluation.approaches.SeenPrediction", "needs": "maps"},
        "rule": {"class": "imagination.mapping.update_rules.MovingAverage", "aggregation_factor": 0.5},
        "postprocess": "none",
        "kernels": [0.0],
    }
    assert as_plain(OmegaConf.create({"a": [1, {"b": None}]})) == {"a": [1, {"b": None}]}


class Knows:
    """Object that refers to itself."""

    def __init__(self) -> None:
        self.itself = self


def local() -> Any:
    class Local:
        pass

    return Local()


@pytest.mark.parametrize(
    "make",
    [
        lambda: lambda: 1,
        local,
        threading.Lock,
        Knows,
        lambda: Gain(threading.Lock()),  # type: ignore[arg-type]
        lambda: Gain(lambda: 1),  # type: ignore[arg-type]
        lambda: (number for number in range(3)),
    ],
)
def test_what_cannot_be_described_is_refused(make: Callable[[], Any]) -> None:
    with pytest.raises(UserError, match="cache: got .*, which cannot be part of the key"):
        as_plain([make()])


def test_an_edit_of_a_class_changes_its_description(tmp_path: Path) -> None:
    def described() -> str:
        with new_process(tmp_path) as imported:
            rule = imported("edited_rules.rule").Rule()
            assert list(plugin_code([{"rule": rule}])) == ["edited_rules.rule"]
            return f"{text(rule)} {plugin_code(rule)}"

    write(
        tmp_path / "edited_rules",
        rule="from edited_rules import helper\nclass Rule:\n    code = helper.VALUE\n",
        helper="VALUE = 1\n",
    )
    first = described()
    assert described() == first
    edit(tmp_path / "edited_rules" / "helper.py", "1", "2")
    second = described()
    edit(tmp_path / "edited_rules" / "rule.py", "class Rule:", "class Rule:  # a comment")
    assert len({first, second, described()}) == 3


class Furniture(ProceduralFurniture):
    """Furniture of a plugin."""


def test_code_of_objects_in_a_scene_source_of_the_core_is_found() -> None:
    table = CategoryTable([Category("chair", (0, 0, 0), {"procedural": ["chair"]})])
    counts = {"train": 1, "val": 1, "test": 1}
    assert plugin_code(ProceduralHomes(0, counts, table, 0.2)) == {}
    assert list(plugin_code(ProceduralHomes(0, counts, table, 0.2, (), Furniture()))) == [__name__]
