"""A cache on disk of what takes long to make: dicts of arrays, found again by a hash of everything they depend on.

A file is a magic line, the sha256 of the rest, and the rest: the length of a JSON header, the header (name, type, shape
and stored size of each array) and the arrays' bytes. True and False are packed eight to a byte; all but uint8 is
compressed, since colour images took 13 % of the time to render them and shrank by 2.3, depth 2 % and 13. A file that
does not fit its checksum is made again. Nothing in a file is ever executed.
"""

import errno
import fcntl
import functools
import hashlib
import json
import logging
import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from importlib.metadata import version
from math import prod
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np

from imagination.utils.errors import CannotWriteError, UserError, check_range

log = logging.getLogger(__name__)

Arrays = dict[str, np.ndarray]

KINDS = "biuf"
"""Of arrays' types: True and False, integers, floats."""
MAGIC = b"imagination cache 1\n"
DIGEST = hashlib.sha256().digest_size

ENTRY, PART = ".bin", ".part"
"""Endings of entries and of files that are being written."""

STALE_SECONDS = 60.0
"""A part older than this that no process holds was left by one that was killed."""

MAKERS = ("geometry", "scenes", "ground_truth", "views", "data", "evaluation")
"""Packages whose code makes the entries: a change in it leaves old entries aside, so none can be out of date."""


@dataclass(frozen=True)
class Cache:
    """Entries in a folder; any number of processes may use it at once.

    When a new entry makes the folder larger than its limit, those that were not used for longest are removed; a
    process that still wants one makes it again. Opening it removes what killed processes left half-written.

    Attributes:
        folder: made when the first entry is stored.
        max_gigabytes: limit of its size.

    Raises:
        UserError: if the limit is out of range.
    """

    folder: str | Path
    max_gigabytes: float = 20.0

    def __post_init__(self) -> None:
        check_range("cache.max_gigabytes", self.max_gigabytes, 0.0, 1_000_000.0, "GB", open_low=True)
        for part in Path(self.folder).glob(f"*/.*{PART}"):
            _remove_if_stale(part)

    def get_or_build(self, kind: str, key: Mapping[str, Any], build: Callable[[], Arrays]) -> Arrays:
        """The entry of a key, made and stored if it is missing or damaged.

        Args:
            kind: of entry, names the subfolder.
            key: everything the entry depends on, as plain values: numbers, strings, lists, dicts, None.
            build: makes the arrays; two processes that miss at once both do, and store the same.

        Raises:
            UserError: if the disk is full or the folder cannot be written.
        """
        arrays = self.load(kind, key)
        if arrays is None:
            arrays = build()
            self.store(kind, key, arrays)
        return arrays

    def load(self, kind: str, key: Mapping[str, Any]) -> Arrays | None:
        """The entry of a key, None if there is none; a damaged one is reported and counts as none.

        Raises:
            UserError: if the file is there and cannot be read.
        """
        path = self.path(kind, key)
        try:
            arrays = decode(path.read_bytes())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise UserError(
                f"cache: cannot read {path}: {error.strerror}; remove it or set paths.cache anew"
            ) from error
        except DamagedError as error:
            log.warning("cache: %s is damaged (%s); it is made again", path, error)
            return None
        with suppress(OSError):  # removed meanwhile, or another user's
            os.utime(path)  # its time says when it was last used
        return arrays

    def store(self, kind: str, key: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Store an entry; readers see the old one or the new one, never a part.

        Raises:
            UserError: if the disk is full or the folder cannot be written.
        """
        path = self.path(kind, key)
        content = encode(arrays)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, content)
            self._make_room(path)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                advice = "the disk is full; free some space, or set paths.cache to a folder elsewhere"
            else:
                advice = f"{error.strerror}; set paths.cache to a folder that can be written"
            raise CannotWriteError(f"cache: cannot write {len(content)} bytes to {path}: {advice}") from error

    def path(self, kind: str, key: Mapping[str, Any]) -> Path:
        """File of the entry, whether it exists or not."""
        whole = {"code": code_version(), "key": key}
        text = json.dumps(whole, sort_keys=True, separators=(",", ":"), allow_nan=True)
        return Path(self.folder) / kind / f"{hashlib.sha256(text.encode()).hexdigest()}{ENTRY}"

    def _make_room(self, newest: Path) -> None:
        """Remove the entries that were not used for longest, but never the newest, until the rest fits."""
        entries = []
        for kind in os.scandir(self.folder):
            for file in os.scandir(kind) if kind.is_dir() else ():
                with suppress(FileNotFoundError):  # another process makes room as well
                    status = file.stat()
                    if file.name.endswith(ENTRY):
                        entries.append((status.st_mtime_ns, status.st_size, file.path))
        total = sum(size for _, size, _ in entries)
        for _, size, path in sorted(entries):
            if total <= self.max_gigabytes * 1e9:
                return
            if path != str(newest):
                Path(path).unlink(missing_ok=True)
                total -= size


@functools.cache
def code_version(packages: tuple[str, ...] = MAKERS) -> str:
    """Hash of the code that makes entries, or of other packages', and of the library that casts its rays."""
    digest = hashlib.sha256(version("embreex").encode())
    for package in packages:
        root = Path(__file__).parents[1] / package
        for path in [root] if root.is_file() else sorted(root.rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


class DamagedError(Exception):
    """A file that is not what was stored."""


def _write(path: Path, content: bytes) -> None:
    with NamedTemporaryFile(dir=path.parent, prefix=".", suffix=PART, delete=False) as file:
        fcntl.flock(file, fcntl.LOCK_SH)  # says that it is in work
        try:
            file.write(content)
            file.flush()
            os.replace(file.name, path)
        except BaseException:  # an interrupt as well: nothing half-written stays behind
            os.unlink(file.name)
            raise


def _remove_if_stale(part: Path) -> None:
    with suppress(FileNotFoundError, BlockingIOError, PermissionError), open(part, "rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # one that was just made may not have been locked yet
        if time.time() - os.fstat(file.fileno()).st_mtime > STALE_SECONDS:
            part.unlink()


def encode(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Arrays as the content of a file; see the module's docstring.

    Raises:
        TypeError: if an array holds anything but numbers, which `decode` would refuse.
    """
    header, parts = [], []
    for name, array in arrays.items():
        if array.dtype.kind not in KINDS:
            raise TypeError(f"cache: got {name} of type {array.dtype}, expected numbers; text goes as bytes")
        raw = (np.packbits(array) if array.dtype == bool else np.ascontiguousarray(array)).tobytes()
        parts.append(raw if array.dtype == np.uint8 else zlib.compress(raw, level=1))
        header.append({"name": name, "type": array.dtype.str, "shape": array.shape, "size": len(parts[-1])})
    text = json.dumps(header).encode()
    body = b"".join([len(text).to_bytes(4, "big"), text, *parts])
    return b"".join([MAGIC, hashlib.sha256(body).digest(), body])


def decode(content: bytes) -> Arrays:
    """The arrays in the content of a file.

    Raises:
        DamagedError: if it is not what `encode` gave.
    """
    start = len(MAGIC) + DIGEST
    body = memoryview(content)[start:]
    if content[: len(MAGIC)] != MAGIC or content[len(MAGIC) : start] != hashlib.sha256(body).digest():
        raise DamagedError("its checksum does not fit")
    try:
        return dict(_arrays(body))
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        OverflowError,
        RecursionError,
        zlib.error,
    ) as error:
        raise DamagedError(
            f"its content is none: {error!r}"
        ) from error  # the checksum fits, but a stranger may have computed it


def _arrays(body: memoryview) -> Iterator[tuple[str, np.ndarray]]:
    place = 4 + int.from_bytes(body[:4], "big")
    for entry in json.loads(bytes(body[4:place])):
        kind, shape = np.dtype(entry["type"]), tuple(entry["shape"])
        if kind.kind not in KINDS or min(shape, default=0) < 0 or entry["size"] < 0:
            raise DamagedError(f"it holds {entry['type']} of the shape {shape}")
        stored = body[place : place + entry["size"]]
        place += entry["size"]
        size = -(-prod(shape) // 8) if kind.kind == "b" else prod(shape) * kind.itemsize
        raw = bytes(stored) if kind == np.uint8 else zlib.decompressobj().decompress(stored, size + 1)
        if len(raw) != size:  # never more than the file says, whatever it unpacks to
            raise DamagedError("its arrays are not as long as it says")
        flat = np.frombuffer(raw, np.uint8)
        whole = (
            np.unpackbits(flat, count=prod(shape)).view(bool) if kind.kind == "b" else flat.copy().view(kind)
        )
        yield entry["name"], whole.reshape(shape)


def as_plain(value: Any) -> Any:
    """Dataclasses, named tuples and mappings as plain values that keys of caches are made of."""
    if is_dataclass(value) and not isinstance(value, type):
        inside = {item.name: as_plain(getattr(value, item.name)) for item in fields(value) if item.init}
        return {"class": f"{type(value).__module__}.{type(value).__qualname__}", **inside}
    if isinstance(value, Mapping):
        return {str(key): as_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_plain(item) for item in value]
    return value
