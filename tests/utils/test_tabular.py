"""Limits of YAML from a run folder or a foreign file; text in CSV and Markdown tables."""

import csv
import os
import time
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagination.utils.errors import UserError
from imagination.utils.tabular import (
    MAX_BYTES,
    csv_text,
    is_number,
    markdown_code,
    read_csv,
    read_yaml,
    to_markdown,
)


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


@given(st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8), min_size=1))
def test_text_of_a_table_returns_as_it_was_and_is_no_formula(cells: list[str]) -> None:
    """A spreadsheet program runs text that begins with one of these characters."""
    text = csv_text([["name", "value"], *([cell, "1"] for cell in cells)])
    with TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        with open(path, "w", newline="", encoding="utf-8") as file:
            file.write(text)
        assert [row["name"] for row in read_csv(path)] == cells
    for row in csv.reader(StringIO(text)):
        assert not row[0].startswith(("=", "+", "-", "@", "\t", "\r")) or is_number(row[0])


def test_numbers_stay_numbers() -> None:
    assert csv_text([["-0.5", "+1.25", -3, "1e-3"]]) == "-0.5,+1.25,-3,1e-3\n"


def test_markdown_shows_text_as_it_is() -> None:
    row = {"a|b": "x|y `code` *bold* [link](javascript:1) <b>\n# head", "n": "iou_pooled"}
    lines = to_markdown([row], list(row)).splitlines()
    assert len(lines) == 3
    assert lines[2] == (r"| x\|y \`code\` \*bold\* \[link\](javascript:1) &lt;b> # head | iou_pooled |")
    assert markdown_code("a `b`\nc") == "`a 'b' c`"
