"""File names of scenes: different names have different file names, all of them inside their folder."""

import re
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from imagination.utils.file_names import file_name

NAMES = st.text(st.sampled_from("ab0/\\._- ~é"), max_size=8) | st.text(max_size=120)


@given(NAMES, NAMES)
@example("a/b", "a_b")
@example("a/b", "a b")
@example("a/b", file_name("a/b"))
@example("/a", "a")
@example("", "_")
@example("a" * 200, "a" * 201)
def test_different_names_have_different_file_names(one: str, other: str) -> None:
    assert (file_name(one) == file_name(other)) == (one == other)


@given(NAMES)
@example("../b c")
@example(".")
@example("\ud800")
def test_a_file_name_is_a_name_in_its_folder(name: str) -> None:
    made = file_name(name)
    assert re.fullmatch(r"\w[\w.+-]*", made, re.ASCII) and len(made) <= 100
    assert (Path("folder") / made).parent == Path("folder")


@pytest.mark.parametrize("name", ["test_0003", "17DRP5sb8fy_0", "scene0000_00", "a.b+c-d"])
def test_ordinary_names_stay(name: str) -> None:
    assert file_name(name) == name


def test_other_names_stay_readable() -> None:
    assert re.fullmatch(r"data_scenes_a\.glb-[0-9a-f]{16}", file_name("/data/scenes/a.glb"))
