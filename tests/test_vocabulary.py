"""The vocabulary of code and configuration: words that the project has replaced do not come back."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import ROOT

BANNED = (
    *("answers", "mirrored_answers", "dilated_answers", "told", "mistakes_told", "manieth", "grown", "tally"),
    *("UntilFlat", "SideBySide", "truth_pixels", "false_pixels", "held_out_views", "scale=desk"),
)
DOCSTRING_STARTS = ("What", "That", "Whose", "Of")
REFUSED_NAMES = [ROOT / "imagination" / "config" / name for name in ("renamed_keys.py", "key_roles.py")]
"""Names the old keys in order to refuse them."""


def sources(*suffixes: str) -> Iterator[Path]:
    for folder in ("imagination", "conf", "plugins"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in suffixes and path not in REFUSED_NAMES:
                yield path
    yield from (path for path in (ROOT / "pyproject.toml",) if path.suffix in suffixes)


def docstrings(text: str) -> Iterator[tuple[int, str]]:
    """Docstrings of modules, classes and functions, and the strings that describe constants."""
    for node in ast.walk(ast.parse(text)):
        for statement in getattr(node, "body", []) if not isinstance(node, (ast.Lambda, ast.IfExp)) else []:
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                if isinstance(statement.value.value, str):
                    yield statement.lineno, statement.value.value


@pytest.mark.parametrize("word", BANNED)
def test_replaced_words_do_not_come_back(word: str) -> None:
    pattern = re.compile(rf"(?<![\w-]){re.escape(word)}(?![\w-])", re.IGNORECASE if word.islower() else 0)
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in sources(".py", ".yaml", ".j2", ".toml")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if pattern.search(line)
    ]
    assert not found, "\n".join(found)


def test_docstrings_begin_with_a_verb_or_a_noun_phrase() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path in sources(".py")
        for line, text in docstrings(path.read_text())
        if text.split()[:1] and text.split()[0] in DOCSTRING_STARTS
    ]
    assert not found, "\n".join(found)
