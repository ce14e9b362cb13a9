"""A .pt2 file from anywhere: torch.export would run what a hostile one tells it, so only what units need passes."""

import io
import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from imagination.errors import UserError

MEMBERS = re.compile(
    r"[^/]+/(models/model\.json|data/(weights|constants)/[\w.-]+|data/sample_inputs/model\.pt|extra/[\w.-]+"
    r"|archive_format|archive_version|byteorder|\.data/(version|serialization_id))"
)
"""Files of a program; others may be compiled code."""

OPERATORS = re.compile(r"torch\.ops\.aten\.\w+\.\w+|_operator\.getitem")
"""What a program may call; torch would look up any function by its name."""

EVALUATED = ("expr_str", "guards_code", "as_operator")
"""Entries that torch runs as Python, or that name functions; programs of fixed sizes have none."""


def vetted(path: Path) -> io.BytesIO:
    """The file's content, packed anew, so that torch reads what was looked at.

    Its pickles are not looked at: load them with `weights_only`.

    Raises:
        UserError: if it holds anything that could run.
        OSError, zipfile.BadZipFile, ValueError, …: whatever a damaged file makes its readers raise.
    """
    packed = io.BytesIO()
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(packed, "w") as copy:
        names = archive.namelist()
        if odd := [name for name in names if not MEMBERS.fullmatch(name) or names.count(name) > 1]:
            raise UserError(
                f"{path}: holds {odd[0]!r}, expected what torch.export has written since torch 2.8; export it again, "
                "or do not use it"
            )
        for name in names:
            content = archive.read(name)
            if name.endswith("/models/model.json"):
                _check(json.loads(content), path)
            copy.writestr(name, content)
    packed.seek(0)
    return packed


def _check(program: Any, path: Path) -> None:
    for key, value in _entries(program):
        called = key == "target" and not (isinstance(value, str) and OPERATORS.fullmatch(value))
        if called or (key in EVALUATED and value):
            raise UserError(
                f"{path}: its program has {key} {str(value)[:60]!r}, which torch would run as Python; do not use it"
            )


def _entries(node: Any) -> Iterator[tuple[str, Any]]:
    """Keys and values at every depth."""
    if isinstance(node, dict):
        yield from node.items()
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else []:
        yield from _entries(child)
