"""Results are those of the reference: a change of structure changes no number."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imagination.views.observer import Observer
from tests.conftest import Command
from tests.reference.results import (
    EXPERIMENTS,
    FOLDER,
    OVERRIDES,
    SCENES,
    integer_maps,
    make_observer,
    pose_hashes,
    scene_hashes,
    table,
)

CELLS = 0.002
"""Fraction of a map's cells that may differ: processors trace rays with other instructions."""


@pytest.fixture(scope="module")
def reference() -> dict[str, Any]:
    content: dict[str, Any] = json.loads((FOLDER / "reference.json").read_text())
    return content


@pytest.fixture(scope="module")
def observer(tmp_path_factory: pytest.TempPathFactory) -> Observer:
    return make_observer(tmp_path_factory.mktemp("cache"))


@pytest.mark.parametrize("name", SCENES)
def test_scenes_and_poses(reference: dict[str, Any], observer: Observer, name: str) -> None:
    assert scene_hashes(observer.scene(name)) == reference["scenes"][name]
    assert pose_hashes(observer, name) == reference["poses"][name]


def test_integer_maps(reference: dict[str, Any], observer: Observer) -> None:
    with np.load(FOLDER / "maps.npz") as stored:
        for name, values in integer_maps(observer):
            assert list(values.shape) == reference["map_shapes"][name]
            expected = np.unpackbits(stored[name], count=values.size).reshape(values.shape).astype(bool)
            assert expected.any(), name
            assert np.count_nonzero(values != expected) <= CELLS * max(values.sum(), 500), name


@pytest.mark.parametrize(
    "experiment", [EXPERIMENTS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in EXPERIMENTS[1:])]
)
def test_tables(reference: dict[str, Any], command: Command, tmp_path: Path, experiment: str) -> None:
    done = command("train", f"+experiment={experiment}", *OVERRIDES, timeout=900)
    assert done.returncode == 0, done.stderr
    found = table(next(tmp_path.glob("outputs/*/latest/tables/mapping.csv")))
    expected = reference["tables"][experiment]
    assert found.keys() == expected.keys()
    for row, values in expected.items():
        for column, value in values.items():
            allowed = 0.005 if column.startswith("iou") else max(3.0, 0.02 * value)
            assert found[row][column] == pytest.approx(value, abs=allowed), (row, column)
