"""Every parser of the list reads its own examples and survives some damaged ones; `make fuzz` gives it many."""

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

import pytest

from tests.robustness import fuzz
from tests.robustness.fuzz import ExcessError, survives
from tests.robustness.parsers import PARSERS, Parser

MEBIBYTE = 2**20


@pytest.mark.parametrize("parser", PARSERS, ids=[parser.name for parser in PARSERS])
def test_damaged_files_get_documented_errors_only(parser: Parser, tmp_path: Path) -> None:
    for number, example in enumerate(parser.examples()):
        (tmp_path / str(number)).write_bytes(example)
        parser.parse(tmp_path / str(number))
    survives(parser, 10, 0, tmp_path / "damaged")


@pytest.mark.parametrize(
    "words", [["minutes=soon"], ["tum-rgb", "minutes=-1"], ["minutes=nan"], ["tum-rgbd"]]
)
def test_what_cannot_be_fuzzed_is_told(words: list[str]) -> None:
    with pytest.raises(SystemExit, match="fuzz: got .*, expected"):
        fuzz.main(words)


def test_parsers_have_names_of_their_own() -> None:
    assert len({parser.name for parser in PARSERS}) == len(PARSERS)


def lenient(parse: Callable[[Path], object]) -> Parser:
    """A parser that documents every error."""
    return Parser("lenient", parse, lambda: [b"x" * 20], (Exception,))


def test_a_parser_that_raises_something_else_is_found_and_the_file_stays(tmp_path: Path) -> None:
    def careless(path: Path) -> object:
        return path.read_bytes()[10]

    with pytest.raises(IndexError):
        survives(Parser("careless", careless, lambda: [b"x" * 20]), 200, 0, tmp_path / "damaged")
    assert len((tmp_path / "damaged").read_bytes()) <= 10
    survives(lenient(careless), 20, 0, tmp_path / "damaged")
    assert not (tmp_path / "damaged").exists()


def patient(path: Path) -> None:
    """Waits for ever, whatever is raised in it."""
    while True:
        with suppress(Exception):
            time.sleep(0.01)


def deaf(path: Path) -> None:
    """Waits long, and tells nothing of having been stopped."""
    with suppress(BaseException):
        time.sleep(60)


def stuck(path: Path) -> None:
    """Waits for ever in C code, which looks at no signal."""
    deque(repeat(0), maxlen=0)


def greedy(path: Path) -> None:
    """Takes too much at once, and gives it back."""
    bytearray(b"x") * (256 * MEBIBYTE)


def insatiable(path: Path) -> None:
    """Takes all that it gets, whatever is raised in it."""
    held = []
    with suppress(Exception):
        while True:
            held.append(bytearray(b"x") * MEBIBYTE)


@pytest.mark.parametrize("parse", [patient, deaf])
def test_a_parser_that_hangs_is_found(
    parse: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzz, "SECONDS_EACH", 0.2)
    with pytest.raises(ExcessError, match=r"still at one file after 0\.2 s"):
        survives(lenient(parse), 1, 0, tmp_path / "damaged")
    assert (tmp_path / "damaged").is_file()


def test_a_parser_that_takes_too_much_memory_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survives(lenient(greedy), 1, 0, tmp_path / "damaged")
    monkeypatch.setattr(fuzz, "MEMORY", 64 * MEBIBYTE)
    with pytest.raises(ExcessError, match="took more than 0.0625 GiB of memory"):
        survives(lenient(greedy), 1, 0, tmp_path / "damaged")


def limited(parse: Callable[[Path], None], path: Path) -> None:
    """What a process does that fuzzes."""
    fuzz.limit_memory()
    survives(lenient(parse), 1, 0, path)


@pytest.mark.parametrize(
    ("parse", "told"), [(stuck, "Timeout (0:00:02"), (insatiable, "took more than 0.25 GiB of memory")]
)
def test_what_only_ends_with_its_process_is_found(
    parse: Callable[[Path], None],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """C code that holds the interpreter, and a parser that swallows the refusal of memory."""
    monkeypatch.setattr(fuzz, "SECONDS_EACH", 1.0)
    monkeypatch.setattr(fuzz, "MEMORY", 256 * MEBIBYTE)
    process = get_context("fork").Process(target=limited, args=(parse, tmp_path / "damaged"))
    process.start()
    process.join(30)
    process.kill()
    assert process.exitcode == 1 and told in capfd.readouterr().err
    assert (tmp_path / "damaged").is_file()


def test_a_process_that_does_not_end_has_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fuzz, "GRACE", 0.0)
    assert fuzz.apart("cache", 0.0) == fuzz.FAILED
    assert "timed out" in capsys.readouterr().out
