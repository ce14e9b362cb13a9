"""Reading of untrusted YAML and CSV files, and tables as CSV and Markdown."""

import csv
import io
import math
import re
import stat
from collections.abc import Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from imagination.utils.errors import UserError

MAX_BYTES = 2**18
"""Largest size of a YAML file."""

MAX_DEPTH = 40
"""Largest depth of nested lists and mappings in a YAML file."""


class PlainLoader(yaml.SafeLoader):
    """YAML loader that refuses references, a few lines of which can expand to any amount of data, and deep nesting."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("got a reference (*), expected plain values")
        if self.depth == MAX_DEPTH:
            raise yaml.YAMLError(f"got more than {MAX_DEPTH} nested lists and mappings, expected fewer")
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        mapping = super().construct_mapping(node, deep)
        if invalid := [key for key in mapping if not isinstance(key, str)]:
            raise yaml.YAMLError(f"got the key {invalid[0]!r}, expected text")
        return mapping


def read_yaml(path: Path, expected: str = "keys and values", last_line: str = "") -> dict[str, Any]:
    """Read keys and values from a YAML file of limited size and depth, without references.

    Args:
        path: path of the file.
        expected: description of the keys for the error message.
        last_line: last line of a file that is not truncated.

    Raises:
        UserError: if the file is missing, damaged or too large, or holds no mapping.
    """
    try:
        text = _read_text(path)
        if not text.endswith(last_line):
            raise yaml.YAMLError(f"it is truncated, expected the last line {last_line.strip()!r}")
        values = yaml.load(text, PlainLoader)  # noqa: S506  (a safe loader)
    except FileNotFoundError as error:
        raise UserError(f"{path}: there is no such file") from error
    except Exception as error:  # yaml raises any type of exception on malformed dates and numbers
        raise UserError(f"{path}: cannot be read ({' '.join(str(error).split())})") from error
    if not isinstance(values, dict):
        raise UserError(f"{path}: got {type(values).__name__}, expected {expected}")
    return values


def _read_text(path: Path) -> str:
    if not stat.S_ISREG(path.stat().st_mode):  # reading a FIFO would block
        raise yaml.YAMLError("it is not a regular file")
    with open(path, "rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise yaml.YAMLError(f"got more than {MAX_BYTES} bytes, expected fewer")
    return content.decode()


FORMULA = re.compile(r"[=+\-@\t\r']")
"""First characters of text that spreadsheet programs run as a formula, and the apostrophe that prevents it."""


def read_csv(path: Path) -> list[dict[str, str]]:
    """Read the rows of a table that `csv_text` wrote.

    Raises:
        ValueError: if a row is shorter or longer than the header.
    """
    with open(path, newline="") as file:
        return parse_csv(file.read())


def parse_csv(text: str) -> list[dict[str, str]]:
    """Return the rows of a table as `csv_text` formats it.

    Raises:
        ValueError: if a row is shorter or longer than the header.
    """
    rows = list(csv.DictReader(io.StringIO(text, newline=""), strict=True))
    for number, row in enumerate(rows, 2):
        if None in row or None in row.values():
            raise ValueError(f"line {number} does not fit the header")
    return [{name.removeprefix("'"): value.removeprefix("'") for name, value in row.items()} for row in rows]


Row = dict[str, str]
"""Formatted cells of one row by column; equal numbers give equal text."""


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows, the header first, as comma-separated text.

    An apostrophe precedes text that a spreadsheet program would run as a formula; `read_csv` removes it.
    """
    lines = []
    for row in rows:
        text = io.StringIO()
        csv.writer(text, lineterminator="\r\n").writerow(
            map(_csv_cell, row)
        )  # quotes both characters in cells
        lines.append(text.getvalue().removesuffix("\r\n") + "\n")
    return "".join(lines)


def _csv_cell(cell: object) -> object:
    if isinstance(cell, str) and FORMULA.match(cell) and not is_number(cell):
        return f"'{cell}"
    return cell


def is_number(text: str) -> bool:
    """Return whether text is a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def to_csv(rows: Sequence[Row]) -> str:
    """Return rows as comma-separated text with a header, or an empty string without rows."""
    if not rows:
        return ""
    columns = list(rows[0])
    return csv_text([columns, *([row[column] for column in columns] for row in rows)])


def to_markdown(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """Return some columns of a table as Markdown; the text of cells is escaped."""
    cells = [[markdown_text(row[column]) for column in columns] for row in rows]
    heads = [markdown_text(column) for column in columns]
    return "\n".join(map(markdown_row, [heads, ["---"] * len(columns), *cells]))


MARKDOWN = {letter: f"\\{letter}" for letter in "\\`*[]|~"} | {
    "<": "&lt;",
    "&": "&amp;",
    "\n": " ",
    "\r": " ",
}
"""Replacements of characters that Markdown would not show as text."""


def markdown_text(text: str) -> str:
    """Escape text for Markdown, tables included; an underscore within a word is text."""
    escaped = "".join(MARKDOWN.get(letter, letter) for letter in text)
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", escaped)


def markdown_code(text: str) -> str:
    """Return text as a code span of Markdown."""
    return f"`{' '.join(text.split()).replace('`', chr(39))}`"


def markdown_row(cells: Sequence[str]) -> str:
    """Return cells, which are Markdown, as one line of a table."""
    return "| " + " | ".join(cells) + " |"
