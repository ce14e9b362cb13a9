"""YAML and CSV files that may have been edited, damaged, or come from a stranger."""

import csv
import io
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import yaml

from imagination.utils.errors import UserError


class PlainLoader(yaml.SafeLoader):
    """Reads YAML without references, a few lines of which could stand for any amount of data."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it holds references (*), which are not read")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        found = super().construct_mapping(node, deep)
        if other := [key for key in found if not isinstance(key, str)]:
            raise yaml.YAMLError(f"got the key {other[0]!r}, expected text")
        return found


def read_yaml(path: Path, expected: str = "keys and values") -> dict[str, Any]:
    """Keys and values in a YAML file.

    Args:
        path: of the file.
        expected: what the keys are, for the message.

    Raises:
        UserError: if it is missing, damaged or holds something else.
    """
    try:
        values = yaml.load(path.read_text(), PlainLoader)  # noqa: S506  (a safe loader)
    except FileNotFoundError as error:
        raise UserError(f"{path}: there is no such file") from error
    except Exception as error:  # yaml raises anything on what looks like a date or a number
        raise UserError(f"{path}: cannot be read ({' '.join(str(error).split())})") from error
    if not isinstance(values, dict):
        raise UserError(f"{path}: got {type(values).__name__}, expected {expected}")
    return values


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a table.

    Raises:
        ValueError: if rows are shorter or longer than the header.
    """
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file, strict=True))
    for number, row in enumerate(rows, 2):
        if None in row or None in row.values():
            raise ValueError(f"line {number} does not fit the header")
    return rows


Row = dict[str, str]
"""Cells of a table's row by column, formatted, so that the same numbers give the same bytes."""


def to_csv(rows: Sequence[Row]) -> str:
    """Rows as comma-separated text with a header; empty without rows."""
    if not rows:
        return ""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def to_markdown(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """Some columns of a table as Markdown."""
    lines = [columns, ["---"] * len(columns), *([row[column] for column in columns] for row in rows)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
