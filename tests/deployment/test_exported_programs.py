"""Unpickling of .pt2 files is restricted to plain data."""

import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from imagination.deployment.load import load
from imagination.utils.errors import UserError
from tests.helpers.checkpoints import samples
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
    """Creates a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return os.mkdir, (str(self.path),)


def test_a_whole_program_passes(program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")  # as some set it for old checkpoints
    observation = samples(1)[0].observation
    again = changed(program, tmp_path / "unit.pt2", lambda members: None)
    np.testing.assert_array_equal(load(again)(observation), load(program)(observation))
    assert os.environ["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] == "1"


@pytest.mark.parametrize("name", ["sample_inputs/model.pt", "weights/a", "constants/tensor_0"])
def test_nothing_but_plain_data_is_unpickled(program: Path, tmp_path: Path, name: str) -> None:
    trace = tmp_path / "it ran"

    def hide(members: Members) -> None:
        kind, _, file = name.partition("/")
        if kind != "sample_inputs":  # torch reads the files of the list in the same folder
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
