"""A .pt2 file from a stranger runs nothing: neither what torch would call, evaluate, unpickle, nor compiled code."""

import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imagination.deployment.load import load
from imagination.errors import UserError
from tests.deployment.checkpoints import samples
from tests.robustness.parsers.units import exported

Members = dict[str, bytes]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("program") / "made"
    exported(folder)
    return folder / "unit.pt2"


def changed(program: Path, to: Path, change: Callable[[Members], None]) -> Path:
    with zipfile.ZipFile(program) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(to, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return to


class Hostile:
    """Makes a file where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return os.mkdir, (str(self.path),)


def in_model(change: Callable[[Any], None]) -> Callable[[Members], None]:
    def changing(members: Members) -> None:
        model = json.loads(members["unit/models/model.json"])
        change(model)
        members["unit/models/model.json"] = json.dumps(model).encode()

    return changing


def call(model: Any) -> None:
    model["graph_module"]["graph"]["nodes"][0]["target"] = "torch.os.system"


def guard(model: Any) -> None:
    model["guards_code"] = ["__import__('os').system('true')"]


def size(model: Any) -> None:
    expression = {"as_expr": {"expr_str": "__import__('os').system('true')", "hint": {"as_int": 3}}}
    model["graph_module"]["graph"]["tensor_values"]["rgb"]["sizes"][1] = expression


def test_a_whole_program_passes(program: Path, tmp_path: Path) -> None:
    observation = samples(1)[0].observation
    again = changed(program, tmp_path / "unit.pt2", lambda members: None)
    np.testing.assert_array_equal(load(again)(observation), load(program)(observation))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (in_model(call), "target 'torch.os.system', which torch would run"),
        (in_model(guard), "guards_code .*, which torch would run"),
        (in_model(size), "expr_str .*, which torch would run"),
        (lambda members: members.update({"unit/data/aotinductor/model/a.so": b"ELF"}), "a.so"),
        (lambda members: members.update({"version": b"8.5"}), "'version', expected what torch.export"),
    ],
)
def test_what_could_run_is_refused(
    program: Path, tmp_path: Path, change: Callable[[Members], None], told: str
) -> None:
    with pytest.raises(UserError, match=told):
        load(changed(program, tmp_path / "unit.pt2", change))


@pytest.mark.parametrize("name", ["sample_inputs/model.pt", "weights/a", "constants/tensor_0"])
def test_nothing_but_plain_data_is_unpickled(program: Path, tmp_path: Path, name: str) -> None:
    trace = tmp_path / "it ran"

    def hide(members: Members) -> None:
        kind, _, file = name.partition("/")
        if kind != "sample_inputs":  # torch reads those that the list beside them names
            entry = {"path_name": file, "is_param": True, "use_pickle": True, "tensor_meta": None}
            listed = members[f"unit/data/{kind}/model_{kind}_config.json"]
            assert json.loads(listed) == {"config": {}}
            members[f"unit/data/{kind}/model_{kind}_config.json"] = json.dumps(
                {"config": {"a": entry}}
            ).encode()
        packed = io.BytesIO()
        pickle.dump((Hostile(trace),), packed)
        members[f"unit/data/{name}"] = packed.getvalue()

    with pytest.raises(UserError, match="cannot be read as a program"):
        load(changed(program, tmp_path / "unit.pt2", hide))
    assert not trace.exists()
    assert "TORCH_FORCE_WEIGHTS_ONLY_LOAD" not in os.environ
