"""Cache on disk of arrays that are expensive to build, addressed by a hash of all their inputs.

File format: a magic line, the SHA-256 of the rest, the length of a JSON header, the header (name, type, shape and
stored size of each array) and the bytes of the arrays. Boolean arrays are packed to bits. All types except uint8 are
compressed: colour images would shrink by a factor of 2.3, but compression takes 13 % of their rendering time; depth
shrinks by a factor of 13 for 2 %. An entry whose checksum does not match is rebuilt. No content is ever executed.

A cache removes only what a cache has written: regular files whose name is a hash and whose content begins with the
magic line, and the temporary folders of such files. It follows no links.
"""

import functools
import hashlib
import json
import logging
import os
import re
import stat
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from imagination.utils.atomic_io import PART, remove_stale_parts, replacing
from imagination.utils.code_hash import core_hash
from imagination.utils.errors import CannotWriteError, UserError, check_range

log = logging.getLogger(__name__)

Arrays = dict[str, np.ndarray]

KINDS = "biuf"
"""Allowed kinds of NumPy types: boolean, integer, float."""
MAGIC = b"imagination cache 1\n"
DIGEST = hashlib.sha256().digest_size

ENTRY = ".bin"
"""Suffix of entries."""

ENTRY_NAME = re.compile(rf"[0-9a-f]{{64}}{re.escape(ENTRY)}")
"""Pattern of the file names of entries: a SHA-256 and the suffix."""

ENTRY_PART = re.compile(rf"\.{ENTRY_NAME.pattern}\.\w+{re.escape(PART)}")
"""Pattern of the names of temporary folders of entries."""

BUILDERS = ("geometry", "scenes", "ground_truth", "views", "data", "evaluation", "utils/jit.py")
"""Packages and modules whose code is in every key, so that no entry is outdated."""


@dataclass(frozen=True)
class Cache:
    """Folder of entries, safe for concurrent use by several processes.

    When a new entry makes the folder larger than its limit, the least recently used entries are removed; a process
    that needs one rebuilds it. The constructor removes partial files of killed processes.

    Attributes:
        folder: path of the folder, which is created with the first entry.
        max_gigabytes: largest size of the folder, GB.

    Raises:
        UserError: if the limit is out of range.
    """

    folder: str | Path
    max_gigabytes: float = 20.0

    def __post_init__(self) -> None:
        check_range("cache.max_gigabytes", self.max_gigabytes, 0.0, 1_000_000.0, "GB", open_low=True)
        remove_stale_parts(Path(item.path) for item in self._items() if ENTRY_PART.fullmatch(item.name))

    def get_or_build(self, kind: str, key: Mapping[str, Any], build: Callable[[], Arrays]) -> Arrays:
        """Load the entry of a key; build and store it if it is missing or damaged.

        Args:
            kind: kind of entry, the name of the subfolder.
            key: all inputs of the entry, as plain values: numbers, strings, lists, dicts, None.
            build: function that returns the arrays. Processes that miss at the same time all build equal entries.

        Raises:
            UserError: if the disk is full or the folder cannot be written.
        """
        arrays = self.load(kind, key)
        if arrays is None:
            arrays = build()
            self.store(kind, key, arrays)
        return arrays

    def load(self, kind: str, key: Mapping[str, Any]) -> Arrays | None:
        """Load the entry of a key; return None if it is missing or damaged, and log the damage.

        Raises:
            UserError: if the file exists but cannot be read.
        """
        path = self.path(kind, key)
        try:
            arrays = decode(_read(path))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise UserError(
                f"cache: cannot read {path}: {error.strerror}; remove it or set paths.cache to another folder"
            ) from error
        except DamagedError as error:
            log.warning("cache: %s is damaged (%s); it will be rebuilt", path, error)
            return None
        with suppress(OSError):  # removed in the meantime, or owned by another user
            os.utime(path)  # time of the last use
        return arrays

    def store(self, kind: str, key: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Store an entry atomically: readers see the old entry or the new one.

        Raises:
            UserError: if the disk is full or the folder cannot be written.
        """
        path = self.path(kind, key)
        content = encode(arrays)
        try:
            with replacing(path, sync=False) as temporary:  # a damaged entry is rebuilt
                temporary.write_bytes(content)
            self._evict(path)
        except OSError as error:
            raise CannotWriteError(
                f"cache: cannot write {len(content)} bytes to {path}: {error.strerror}; set paths.cache to a writable "
                "folder"
            ) from error

    def path(self, kind: str, key: Mapping[str, Any]) -> Path:
        """Return the path of an entry, whether or not it exists."""
        inputs = {"code": code_version(), "key": key}
        text = json.dumps(inputs, sort_keys=True, separators=(",", ":"), allow_nan=True)
        return Path(self.folder) / kind / f"{hashlib.sha256(text.encode()).hexdigest()}{ENTRY}"

    def _evict(self, newest: Path) -> None:
        """Remove the least recently used entries, but never the newest, until the size is below the limit."""
        entries = []
        for item in self._items():
            with suppress(FileNotFoundError):  # removed by another process
                if ENTRY_NAME.fullmatch(item.name) and item.is_file(follow_symlinks=False):
                    status = item.stat(follow_symlinks=False)
                    entries.append((status.st_mtime_ns, status.st_size, item.path))
        total = sum(size for _, size, _ in entries)
        for _, size, path in sorted(entries):
            if total <= self.max_gigabytes * 1e9:
                return
            if path != str(newest) and _is_entry(path):
                Path(path).unlink(missing_ok=True)
                total -= size

    def _items(self) -> Iterator[os.DirEntry[str]]:
        """Yield what the subfolders contain, except for links to folders and for folders that cannot be read."""
        with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            for kind in os.scandir(self.folder):
                if kind.is_dir(follow_symlinks=False):
                    with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
                        yield from os.scandir(kind)


def _is_entry(path: str) -> bool:
    """Return whether a path is a regular file, and no link, that begins as `encode` begins it."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with open(descriptor, "rb") as file:
            return stat.S_ISREG(os.fstat(descriptor).st_mode) and file.read(len(MAGIC)) == MAGIC
    return False


def _read(path: Path) -> bytes:
    """Return the content of a file.

    Raises:
        DamagedError: if the path is a FIFO or a device, which could block or never end.
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise DamagedError("it is not a regular file")
        return file.read()


@functools.cache
def code_version(packages: tuple[str, ...] = BUILDERS) -> str:
    """Return the hash of the code of packages and modules, by default `BUILDERS`, and of the ray caster's version."""
    return hashlib.sha256(f"{core_hash(packages)} {version('embreex')}".encode()).hexdigest()


class DamagedError(Exception):
    """File whose content differs from what was stored."""


def encode(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Encode arrays as the content of a file, in the format of the module's docstring.

    Raises:
        TypeError: if the type of an array is not in `KINDS`, which `decode` would refuse.
    """
    header, blocks = [], []
    for name, array in arrays.items():
        if array.dtype.kind not in KINDS:
            raise TypeError(
                f"cache: got {name} of type {array.dtype}, expected numbers; store text as an array of bytes"
            )
        raw = (np.packbits(array) if array.dtype == bool else np.ascontiguousarray(array)).tobytes()
        blocks.append(raw if array.dtype == np.uint8 else zlib.compress(raw, level=1))
        header.append({"name": name, "type": array.dtype.str, "shape": array.shape, "size": len(blocks[-1])})
    text = json.dumps(header).encode()
    body = b"".join([len(text).to_bytes(4, "big"), text, *blocks])
    return b"".join([MAGIC, hashlib.sha256(body).digest(), body])


def decode(content: bytes) -> Arrays:
    """Decode the arrays in the content of a file.

    Raises:
        DamagedError: if the content was not made by `encode`.
    """
    start = len(MAGIC) + DIGEST
    body = memoryview(content)[start:]
    if content[: len(MAGIC)] != MAGIC or content[len(MAGIC) : start] != hashlib.sha256(body).digest():
        raise DamagedError("its checksum does not match")
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
        # despite a valid checksum, which anyone can compute
        raise DamagedError(f"its content is invalid: {error!r}") from error


def _arrays(body: memoryview) -> Iterator[tuple[str, np.ndarray]]:
    offset = 4 + int.from_bytes(body[:4], "big")
    for entry in json.loads(bytes(body[4:offset])):
        dtype, shape = np.dtype(entry["type"]), tuple(entry["shape"])
        if dtype.kind not in KINDS or min(shape, default=0) < 0 or entry["size"] < 0:
            raise DamagedError(f"got an array of type {entry['type']} and shape {shape}")
        stored = body[offset : offset + entry["size"]]
        offset += entry["size"]
        size = -(-prod(shape) // 8) if dtype.kind == "b" else prod(shape) * dtype.itemsize
        raw = bytes(stored) if dtype == np.uint8 else zlib.decompressobj().decompress(stored, size + 1)
        if len(raw) != size:  # decompression stops after the stated size
            raise DamagedError("the length of an array differs from its header")
        flat = np.frombuffer(raw, np.uint8)
        if dtype.kind == "b":
            array = np.unpackbits(flat, count=prod(shape)).view(bool)
        else:
            array = flat.copy().view(dtype)
        yield entry["name"], array.reshape(shape)
