"""What a parser is, and what several of them share."""

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
    """One parser.

    Attributes:
        name: for the command line.
        parse: reads a file.
        examples: contents of valid files.
        documented: what it may raise on others.
    """

    name: str
    parse: Parse
    examples: Examples
    documented: tuple[type[Exception], ...] = (UserError,)


def kept(make: Callable[[Path], object]) -> Callable[[], Path]:
    """A folder that is made when it is first asked for, and removed at the end."""

    @cache
    def made() -> Path:
        parent = Path(tempfile.mkdtemp())
        atexit.register(shutil.rmtree, parent)
        make(parent / "made")
        return parent / "made"

    return made


def exchanged(made: Callable[[], Path], name: str, read: Callable[[Path], object]) -> tuple[Parse, Examples]:
    """What reads a copy of a folder one of whose files is another, and what that file is."""

    def parse(path: Path) -> object:
        with tempfile.TemporaryDirectory() as scratch:
            folder = shutil.copytree(made(), Path(scratch) / "copy")
            shutil.copyfile(path, folder / name)
            return read(folder)

    return parse, lambda: [(made() / name).read_bytes()]


def named(name: str, read: Callable[[Path], object]) -> Parse:
    """What reads a file under a name."""

    def parse(path: Path) -> object:
        with tempfile.TemporaryDirectory() as scratch:
            return read(Path(shutil.copyfile(path, Path(scratch) / name)))

    return parse


SPLIT = b"\n####\n"
"""Between the members of an archive that a file stands for."""


def within(names: Sequence[str], name: str, read: Callable[[Path], object]) -> Parse:
    """Read an archive of a name whose members with these names are the parts of the file: checksums of archives fit."""

    def parse(path: Path) -> object:
        parts = path.read_bytes().split(SPLIT, len(names) - 1)
        with tempfile.TemporaryDirectory() as scratch:
            with zipfile.ZipFile(Path(scratch) / name, "w") as archive:
                for member, content in zip(names, parts, strict=False):
                    archive.writestr(member, content)
            return read(Path(scratch) / name)

    return parse


def resealed(parse: Parse, examples: Examples) -> tuple[Parse, Examples]:
    """The same of archives whose members were damaged before they were packed."""

    @cache
    def members() -> tuple[list[str], bytes]:
        with zipfile.ZipFile(io.BytesIO(examples()[0])) as archive:
            return archive.namelist(), SPLIT.join(map(archive.read, archive.namelist()))

    return lambda path: within(members()[0], "a.zip", parse)(path), lambda: [members()[1]]
