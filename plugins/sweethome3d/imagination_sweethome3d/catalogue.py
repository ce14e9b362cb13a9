"""Catalogues of furniture: the `.sh3f` archives and what each of their entries says."""

import hashlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from imagination.utils.errors import UserError
from imagination_sweethome3d.archives import MAX_TEXT, Archive, opened

PROPERTIES = "PluginFurnitureCatalog.properties"
LINE = re.compile(r"\s*(\w+)#(\d{1,9})\s*[=:]\s*(.*)")
ESCAPES = re.compile(r"(?:\\u[0-9a-fA-F]{4})+")
"""A run of characters beyond Latin-1: those beyond 16 bits are written as two that belong together."""


@dataclass(frozen=True)
class Entry:
    """One piece of furniture as a catalogue describes it.

    Attributes:
        id: unique, e.g. "Scopia#chair".
        name, tags, section: in English.
        model: member of the archive that holds its mesh.
        size: width, depth and height, metres.
        rotation: of the mesh's axes (x, y up, z to the front) before it is scaled.
        door_or_window: whether it belongs into a wall.
        creator: who made it.
        licence: of its archive.
        archive: file name of the archive.
    """

    id: str
    name: str
    tags: str
    section: str
    model: str
    size: tuple[float, float, float]
    rotation: tuple[float, ...]
    door_or_window: bool
    creator: str
    licence: str
    archive: str

    @property
    def turn(self) -> Float[np.ndarray, "3 3"]:
        """The rotation as a matrix."""
        return np.array(self.rotation).reshape(3, 3)


@dataclass(frozen=True)
class Catalogue:
    """An archive's entries; `problems` are those that cannot be read, by their number, with the reason."""

    path: Path
    entries: tuple[Entry, ...]
    problems: tuple[tuple[str, str], ...]


def read_catalogue(path: Path) -> Catalogue:
    """Read an archive's catalogue.

    Raises:
        UserError: if it is no archive of furniture.
    """
    return _read(path.resolve(), _time(path))


@lru_cache(maxsize=32)
def _read(path: Path, _time: int) -> Catalogue:
    with opened(path) as archive:
        if PROPERTIES not in archive:
            raise UserError(f"{path}: has no {PROPERTIES}, expected a furniture archive (.sh3f)")
        rows = _rows(archive.lines(PROPERTIES, MAX_TEXT))
        licence = _licence(archive)
    entries, problems = [], []
    for number, row in rows.items():
        try:
            entries.append(_entry(row, licence, path.name))
        except (KeyError, ValueError) as error:
            problems.append((row.get("id", f"entry {number}"), f"its catalogue entry is broken: {error!r}"))
    if not entries:
        raise UserError(f"{path}: its {PROPERTIES} describes no furniture")
    return Catalogue(path, tuple(entries), tuple(problems))


def names_in_all_languages(path: Path) -> dict[str, set[str]]:
    """For each entry's id its names in every language that the archive speaks, in lower case."""
    with opened(path) as archive:
        ids = {
            number: row["id"]
            for number, row in _rows(archive.lines(PROPERTIES, MAX_TEXT)).items()
            if "id" in row
        }
        names: dict[str, set[str]] = {}
        for member in archive:
            if member.startswith("PluginFurnitureCatalog") and member.endswith(".properties"):
                for number, row in _rows(archive.lines(member, MAX_TEXT)).items():
                    if number in ids and "name" in row:
                        names.setdefault(ids[number], set()).add(row["name"].casefold())
    return names


def fingerprint(path: Path) -> str:
    """Hash of an archive's content.

    Raises:
        UserError: if it cannot be read.
    """
    return _hash(path.resolve(), _time(path))


def _time(path: Path) -> int:
    """When a file was changed last; 0 if it is none, which its reader then tells."""
    return path.stat().st_mtime_ns if path.is_file() else 0


@lru_cache(maxsize=32)
def _hash(path: Path, _time: int) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from error


def _rows(lines: Iterable[str]) -> dict[int, dict[str, str]]:
    """Keys and values of each numbered entry of a Java properties file."""
    rows: dict[int, dict[str, str]] = {}
    for line in lines:
        if match := LINE.match(line):
            text = ESCAPES.sub(_unescaped, match[3]).strip()
            rows.setdefault(int(match[2]), {})[match[1]] = text
    return rows


def _unescaped(run: re.Match[str]) -> str:
    return bytes.fromhex(run[0].replace("\\u", "")).decode("utf-16-be", "replace")


def _entry(row: dict[str, str], licence: str, archive: str) -> Entry:
    width, depth, height = (float(row[key]) / 100 for key in ("width", "depth", "height"))
    if not all(0 < side < 100 for side in (width, depth, height)):
        raise ValueError(f"its size is {width} x {depth} x {height} m")
    rotation = tuple(float(value) for value in row.get("modelRotation", "1 0 0 0 1 0 0 0 1").split())
    turn = np.array(rotation)
    if len(rotation) != 9 or np.abs(turn.reshape(3, 3) @ turn.reshape(3, 3).T - np.eye(3)).max() > 1e-2:
        raise ValueError(f"its modelRotation is {rotation}")
    return Entry(
        row["id"],
        row["name"],
        row.get("tags", ""),
        row.get("category", ""),
        row["model"].lstrip("/"),
        (width, depth, height),
        rotation,
        row.get("doorOrWindow", "false") == "true",
        row.get("creator", "unknown"),
        licence,
        archive,
    )


def _licence(archive: Archive) -> str:
    """The licence that an archive's LICENSE.TXT names, for lists of credits."""
    text = "".join(archive.read(name, MAX_TEXT).decode("latin-1") for name in _licence_files(archive)).lower()
    united_states = "/by/3.0/us" in text
    if "creative commons zero" in text:
        return "CC0 1.0"
    if "creativecommons.org/licenses/by/3.0" in text:
        return "CC BY 3.0 US" if united_states else "CC BY 3.0"
    return "see the archive's LICENSE.TXT" if text else "unknown"


def _licence_files(archive: Archive) -> Iterator[str]:
    return (name for name in archive if name.upper() == "LICENSE.TXT")
