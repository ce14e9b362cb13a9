"""Interface of parsers under test, and helpers shared by them."""

import atexit
import io
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from imagination.utils.errors import UserError

Parse = Callable[[Path], object]
Examples = Callable[[], Sequence[bytes]]


class Parser(NamedTuple):
    """Parser under test.

    Attributes:
        name: name on the command line.
        parse: function that reads a file.
        examples: function that returns the contents of valid files.
        documented: errors that it may raise for other files.
    """

    name: str
    parse: Parse
    examples: Examples
    documented: tuple[type[Exception], ...] = (UserError,)


def temporary_folder(write: Callable[[Path], object]) -> Callable[[], Path]:
    """Return a function that writes a folder on its first call; the folder is removed at exit."""

    @cache
    def folder() -> Path:
        parent = Path(tempfile.mkdtemp())
        atexit.register(shutil.rmtree, parent)
        write(parent / "written")
        return parent / "written"

    return folder


def with_file_replaced(
    folder: Callable[[], Path], name: str, read: Callable[[Path], object]
) -> tuple[Parse, Examples]:
    """Return a parser that reads a copy of a folder with one file replaced, and the valid file as example."""

    def parse(path: Path) -> object:
        with tempfile.TemporaryDirectory() as scratch:
            copy = shutil.copytree(folder(), Path(scratch) / "copy")
            shutil.copyfile(path, copy / name)
            return read(copy)

    return parse, lambda: [(folder() / name).read_bytes()]


SPLIT = b"\n####\n"
"""Separator of the members of an archive in one file."""


def in_archive(names: Sequence[str], name: str, read: Callable[[Path], object]) -> Parse:
    """Return a parser that packs the parts of a file as members of an archive, so that its checksums are valid."""

    def parse(path: Path) -> object:
        parts = path.read_bytes().split(SPLIT, len(names) - 1)
        with tempfile.TemporaryDirectory() as scratch:
            with zipfile.ZipFile(Path(scratch) / name, "w") as archive:
                for member, content in zip(names, parts, strict=False):
                    archive.writestr(member, content)
            return read(Path(scratch) / name)

    return parse


def resealed(parse: Parse, examples: Examples) -> tuple[Parse, Examples]:
    """Return a parser of archives whose members are damaged before they are packed, and its example."""

    @cache
    def members() -> tuple[list[str], bytes]:
        with zipfile.ZipFile(io.BytesIO(examples()[0])) as archive:
            return archive.namelist(), SPLIT.join(map(archive.read, archive.namelist()))

    return lambda path: in_archive(members()[0], "a.zip", parse)(path), lambda: [members()[1]]
