"""Untrusted zip archives: sizes are bounded, and nothing is unpacked to disk."""

import io
import posixpath
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from imagination.utils.errors import UserError

MAX_MEMBER = 64 * 2**20
"""Maximum uncompressed size of a member, bytes."""
MAX_TOTAL = 2 * 2**30
"""Maximum uncompressed size of an archive by its directory, bytes."""
MAX_MEMBERS = 100_000
"""Maximum number of members of an archive."""
MAX_RATIO = 1000
"""Maximum compression ratio of a member; deflate alone reaches 1032 on zeros."""
RATIO_FROM = 2**20
"""Uncompressed size above which the compression ratio is checked, bytes."""
MAX_TEXT = 16 * 2**20
"""Maximum size of a member that is parsed as a whole (a plan or a catalogue), bytes."""
MAX_LINE = 2**16
"""Maximum length of a line of text, characters."""


class Archive:
    """Members of an open zip file by their normalised names."""

    def __init__(self, path: Path, file: zipfile.ZipFile) -> None:
        self.path = path
        self._file = file
        members = file.infolist()
        total = sum(member.file_size for member in members)
        if len(members) > MAX_MEMBERS or total > MAX_TOTAL:
            raise UserError(
                f"{path}: got {len(members)} members of {total} bytes unpacked, expected at most {MAX_MEMBERS} members "
                f"of {MAX_TOTAL} bytes; the archive is not used"
            )
        self._members = {
            _name(path, member.filename): member for member in members if not member.filename.endswith("/")
        }

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def read(self, name: str, max_bytes: int = MAX_MEMBER) -> bytes:
        """Return the bytes of a member.

        Raises:
            UserError: if the member is missing, damaged, encrypted or larger than `max_bytes`.
        """
        member = self._members.get(name)
        if member is None:
            raise UserError(f"{self.path}: has no member {name}")
        if member.file_size > max_bytes or (
            member.file_size > RATIO_FROM and member.file_size > MAX_RATIO * max(member.compress_size, 1)
        ):
            raise UserError(
                f"{self.path}: {name} unpacks from {member.compress_size} to {member.file_size} bytes, expected at "
                f"most {max_bytes} bytes and a ratio of at most {MAX_RATIO}; the archive is not used"
            )
        try:
            with self._file.open(member) as file:
                content = file.read(max_bytes + 1)  # the size in the directory may be wrong
        except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, OSError) as error:
            raise UserError(f"{self.path}: {name} cannot be read: {error}") from error
        except Exception as error:  # zlib.error and lzma.LZMAError have no common base
            raise UserError(f"{self.path}: {name} is damaged: {error}") from error
        if len(content) > max_bytes:
            raise UserError(
                f"{self.path}: {name} unpacks to more than {max_bytes} bytes; the archive is not used"
            )
        return content

    def lines(self, name: str, max_bytes: int = MAX_MEMBER) -> Iterator[str]:
        """Yield the lines of a Latin-1 text.

        Raises:
            UserError: if the member cannot be read, or a line is longer than MAX_LINE.
        """
        text = io.TextIOWrapper(io.BytesIO(self.read(name, max_bytes)), "latin-1")
        while line := text.readline(MAX_LINE + 1):
            if len(line) > MAX_LINE:
                raise UserError(
                    f"{self.path}: {name} has a line of more than {MAX_LINE} characters; the archive is not used"
                )
            yield line


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """Open an archive for reading.

    Raises:
        UserError: if the file does not exist, is not a zip file, or breaks the limits of `Archive`.
    """
    try:
        file = zipfile.ZipFile(path)
    except FileNotFoundError as error:
        raise UserError(f"{path}: does not exist") from error
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from error
    except (zipfile.BadZipFile, NotImplementedError, ValueError, OverflowError, struct.error) as error:
        raise UserError(f"{path}: is not a zip file, or is damaged ({error})") from error
    with file:
        yield Archive(path, file)


def _name(path: Path, name: str) -> str:
    """Return the name of a member as a normalised path; refuse an empty name or one outside the archive."""
    plain = posixpath.normpath(name.replace("\\", "/"))
    if plain.startswith(("/", "../")) or plain in (".", "..") or ":" in plain.partition("/")[0]:
        raise UserError(
            f"{path}: member {name!r} has no file name or leads out of the archive; the archive is not used"
        )
    return plain
