"""YAML from a run folder or a foreign file: size, depth and references are limited."""

import os
import time
from pathlib import Path

import pytest

from imagination.utils.errors import UserError
from imagination.utils.tabular import MAX_BYTES, read_yaml


def laughs(levels: int) -> str:
    """Return a few lines whose aliases stand for 9 ** levels values."""
    lines = ["a0: &a0 [x]"]
    lines += [f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 9)}]" for n in range(1, levels + 1)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text",
    [
        laughs(30),
        "a: &a {b: *a}",
        "a: " + "[" * 5_000 + "]" * 5_000,
        "a: " + "[" * 45 + "]" * 45,
        "".join(f"{' ' * n}a:\n" for n in range(60)),
        "a: " + "x" * MAX_BYTES,
        "a: !!python/object/apply:os.system [ls]",
        "1: a",
        "[a]",
        "",
    ],
)
def test_hostile_files_are_refused_quickly(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    start = time.perf_counter()
    with pytest.raises(UserError, match="a.yaml: "):
        read_yaml(tmp_path / "a.yaml")
    assert time.perf_counter() - start < 5.0


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "folder").mkdir()
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("fifo", "folder", "zero", "missing"):
        with pytest.raises(UserError, match=f"{name}: "):
            read_yaml(tmp_path / name)


def test_nested_values_and_the_last_line(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: " + "[" * 30 + "]" * 30 + "\nb: {c: 1.0e-05, d: null}\n...\n")
    assert read_yaml(tmp_path / "a.yaml", last_line="...\n")["b"] == {"c": 1e-5, "d": None}
    (tmp_path / "a.yaml").write_text("b: 1\n")
    with pytest.raises(UserError, match=r"expected the last line '\.\.\.'"):
        read_yaml(tmp_path / "a.yaml", last_line="...\n")
