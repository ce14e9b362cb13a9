"""Parsers read their examples and raise documented errors for a few damaged files; `make fuzz` tests many files."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from tests.robustness import fuzz
from tests.robustness.fuzz import ExcessError, check_parser
from tests.robustness.parsers import PARSERS, Parser

MEBIBYTE = 2**20


def parsers() -> Iterator[Any]:
    """Every parser; those that make a whole report need seconds for each file, and tests/reporting reads such files."""
    for parser in PARSERS:
        marks = [pytest.mark.slow] if parser.name.startswith(("results-", "sweep-")) else []
        yield pytest.param(parser, id=parser.name, marks=marks)


@pytest.mark.parametrize("parser", parsers())
def test_damaged_files_get_documented_errors_only(parser: Parser, tmp_path: Path) -> None:
    for number, example in enumerate(parser.examples()):
        (tmp_path / str(number)).write_bytes(example)
        parser.parse(tmp_path / str(number))
    check_parser(parser, 3, 0, tmp_path / "damaged")


@pytest.mark.parametrize(
    "words", [["minutes=soon"], ["tum-rgb", "minutes=-1"], ["minutes=nan"], ["tum-rgbd"]]
)
def test_invalid_arguments_are_reported(words: list[str]) -> None:
    with pytest.raises(SystemExit, match="fuzz: got .*, expected"):
        fuzz.main(words)


def test_parsers_have_unique_names() -> None:
    assert len({parser.name for parser in PARSERS}) == len(PARSERS)


def lenient(parse: Callable[[Path], object]) -> Parser:
    """Return a parser that documents every error."""
    return Parser("lenient", parse, lambda: [b"x" * 20], (Exception,))


def test_an_undocumented_error_is_detected_and_the_file_is_kept(tmp_path: Path) -> None:
    def careless(path: Path) -> object:
        return path.read_bytes()[10]

    with pytest.raises(IndexError):
        check_parser(Parser("careless", careless, lambda: [b"x" * 20]), 200, 0, tmp_path / "damaged")
    assert len((tmp_path / "damaged").read_bytes()) <= 10
    check_parser(lenient(careless), 20, 0, tmp_path / "damaged")
    assert not (tmp_path / "damaged").exists()


def catch_exceptions(path: Path) -> None:
    """Wait forever and catch every Exception."""
    while True:
        with suppress(Exception):
            time.sleep(0.01)


def catch_everything(path: Path) -> None:
    """Wait for long and catch the interruption."""
    with suppress(BaseException):
        time.sleep(60)


def block_in_c(path: Path) -> None:
    """Block forever in C code, which handles no signal."""
    deque(repeat(0), maxlen=0)


def allocate_once(path: Path) -> None:
    """Allocate too much memory at once and free it."""
    bytearray(b"x") * (256 * MEBIBYTE)


def allocate_all(path: Path) -> None:
    """Allocate all memory and catch the error."""
    held = []
    with suppress(Exception):
        while True:
            held.append(bytearray(b"x") * MEBIBYTE)


@pytest.mark.parametrize("parse", [catch_exceptions, catch_everything])
def test_a_hanging_parser_is_detected(
    parse: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzz, "MAX_SECONDS", 0.2)
    with pytest.raises(ExcessError, match=r"more than 0\.2 s"):
        check_parser(lenient(parse), 1, 0, tmp_path / "damaged")
    assert (tmp_path / "damaged").is_file()


def test_a_parser_with_too_much_memory_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_parser(lenient(allocate_once), 1, 0, tmp_path / "damaged")
    monkeypatch.setattr(fuzz, "MAX_MEMORY", 64 * MEBIBYTE)
    with pytest.raises(ExcessError, match=r"more than 0\.0625 GiB"):
        check_parser(lenient(allocate_once), 1, 0, tmp_path / "damaged")


def fuzz_with_limit(parse: Callable[[Path], None], path: Path) -> None:
    """Run the body of a fuzzing process."""
    fuzz.limit_memory()
    check_parser(lenient(parse), 1, 0, path)


@pytest.mark.parametrize(
    ("parse", "seconds", "message"),
    [(block_in_c, 1.0, "Timeout (0:00:02"), (allocate_all, 20.0, "more than 0.25 GiB")],
)
def test_a_parser_that_ends_only_with_its_process_is_detected(
    parse: Callable[[Path], None],
    seconds: float,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """C code that blocks the interpreter, and a parser that catches the MemoryError."""
    monkeypatch.setattr(fuzz, "MAX_SECONDS", seconds)
    monkeypatch.setattr(fuzz, "MAX_MEMORY", 256 * MEBIBYTE)
    process = get_context("fork").Process(target=fuzz_with_limit, args=(parse, tmp_path / "damaged"))
    process.start()
    process.join(30)
    process.kill()
    assert process.exitcode == 1 and message in capfd.readouterr().err
    assert (tmp_path / "damaged").is_file()


def test_a_process_that_does_not_end_has_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fuzz, "GRACE", 0.0)
    assert fuzz.fuzz_in_process("cache", 0.0) == fuzz.FAILED
    assert "timed out" in capsys.readouterr().out
