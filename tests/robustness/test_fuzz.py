"""Every parser of the list reads its own examples and survives some damaged ones; `make fuzz` gives it many."""

from pathlib import Path

import pytest

from tests.robustness.fuzz import survives
from tests.robustness.parsers import PARSERS, Parser


@pytest.mark.parametrize("parser", PARSERS, ids=[parser.name for parser in PARSERS])
def test_damaged_files_get_documented_errors_only(parser: Parser, tmp_path: Path) -> None:
    for number, example in enumerate(parser.examples()):
        (tmp_path / str(number)).write_bytes(example)
        parser.parse(tmp_path / str(number))
    survives(parser, 20, 0)


def test_a_parser_that_raises_something_else_is_found(tmp_path: Path) -> None:
    def careless(path: Path) -> object:
        return path.read_bytes()[10]

    with pytest.raises(IndexError):
        survives(Parser("careless", careless, lambda: [b"x" * 20]), 200, 0)
