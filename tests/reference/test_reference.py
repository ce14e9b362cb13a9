"""Results are those of the reference: a change of structure changes no number."""

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
    check_table,
    integer_maps,
    make_observer,
    pose_hashes,
    read_reference,
    scene_hashes,
)

CELLS = 0.002
"""Fraction of a map's cells that may differ: processors trace rays with other instructions."""


@pytest.fixture(scope="module")
def reference() -> dict[str, Any]:
    return read_reference()


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


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_tables(command: Command, tmp_path: Path, experiment: str) -> None:
    """The table of chair_unet is also checked by the test of a whole run."""
    done = command("train", f"+experiment={experiment}", *OVERRIDES, timeout=900)
    assert done.returncode == 0, done.stderr
    check_table(next(tmp_path.glob("outputs/*/latest/tables/mapping.csv")), experiment)
