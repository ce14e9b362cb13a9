"""Zip archives that may come from a stranger: sizes are bounded, nothing is ever unpacked to disk."""

import io
import posixpath
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from imagination.utils.errors import UserError

MAX_MEMBER = 64 * 2**20
"""Most bytes that one member may unpack to."""
MAX_TOTAL = 2 * 2**30
"""Most bytes that an archive may claim in all."""
MAX_MEMBERS = 100_000
RATIO = 1000
"""Most times that a member may grow; deflate alone reaches 1032 on zeros."""
SMALL = 2**20
"""Bytes from which the ratio counts."""
MAX_TEXT = 16 * 2**20
"""Most bytes of a member that is read as a whole before it can be judged: a plan, a catalogue."""
MAX_LINE = 2**16
"""Most characters that a line of a text may have."""


class Archive:
    """Members of one open zip file, by their normalised names."""

    def __init__(self, path: Path, file: zipfile.ZipFile) -> None:
        self.path = path
        self._file = file
        members = file.infolist()
        total = sum(member.file_size for member in members)
        if len(members) > MAX_MEMBERS or total > MAX_TOTAL:
            raise UserError(
                f"{path}: got {len(members)} members of {total} bytes unpacked, expected at most {MAX_MEMBERS} of "
                f"{MAX_TOTAL}; it is not used"
            )
        self._members = {
            _name(path, member.filename): member for member in members if not member.filename.endswith("/")
        }

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def read(self, name: str, most: int = MAX_MEMBER) -> bytes:
        """The bytes of a member, at most so many.

        Raises:
            UserError: if it is missing, damaged, encrypted or too large.
        """
        member = self._members.get(name)
        if member is None:
            raise UserError(f"{self.path}: has no {name}")
        if member.file_size > most or (
            member.file_size > SMALL and member.file_size > RATIO * max(member.compress_size, 1)
        ):
            raise UserError(
                f"{self.path}: {name} unpacks from {member.compress_size} to {member.file_size} bytes, expected at "
                f"most {most} and {RATIO} times as many; it is not used"
            )
        try:
            with self._file.open(member) as file:
                content = file.read(most + 1)  # what the directory claims may be a lie
        except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, OSError) as error:
            raise UserError(f"{self.path}: {name} cannot be read: {error}") from error
        except Exception as error:  # zlib.error and lzma.LZMAError have no common base
            raise UserError(f"{self.path}: {name} is damaged: {error}") from error
        if len(content) > most:
            raise UserError(f"{self.path}: {name} unpacks to more than {most} bytes; it is not used")
        return content

    def lines(self, name: str, most: int = MAX_MEMBER) -> Iterator[str]:
        """The lines of a text in Latin-1, one at a time.

        Raises:
            UserError: if it cannot be read, or has a line that is too long.
        """
        text = io.TextIOWrapper(io.BytesIO(self.read(name, most)), "latin-1")
        while line := text.readline(MAX_LINE + 1):
            if len(line) > MAX_LINE:
                raise UserError(
                    f"{self.path}: {name} has a line of more than {MAX_LINE} characters; it is not used"
                )
            yield line


@contextmanager
def opened(path: Path) -> Iterator[Archive]:
    """An archive, open for reading.

    Raises:
        UserError: if it does not exist, is no zip file, or holds what no archive should.
    """
    try:
        file = zipfile.ZipFile(path)
    except FileNotFoundError as error:
        raise UserError(f"{path}: there is no such file") from error
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from error
    except (zipfile.BadZipFile, NotImplementedError, ValueError, OverflowError, struct.error) as error:
        raise UserError(f"{path}: is not a zip file or is damaged ({error})") from error
    with file:
        yield Archive(path, file)


def _name(path: Path, name: str) -> str:
    """A member's name as a relative path, refused if it has none or leads out of the archive."""
    plain = posixpath.normpath(name.replace("\\", "/"))
    if plain.startswith(("/", "../")) or plain in (".", "..") or ":" in plain.partition("/")[0]:
        raise UserError(
            f"{path}: its member {name!r} names no file or leads out of the archive; it is not used"
        )
    return plain
