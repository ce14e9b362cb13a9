"""Furniture catalogues: parser of `.sh3f` archives and their entries."""

import hashlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from imagination.utils.errors import UserError
from imagination_sweethome3d.archives import MAX_TEXT, Archive, open_archive

PROPERTIES = "PluginFurnitureCatalog.properties"
LINE = re.compile(r"\s*(\w+)#(\d{1,9})\s*[=:]\s*(.*)")
ESCAPES = re.compile(r"(?:\\u[0-9a-fA-F]{4})+")
"""Consecutive Unicode escapes; characters beyond 16 bits are written as a surrogate pair."""


@dataclass(frozen=True)
class Entry:
    """Catalogue entry of a piece of furniture.

    Attributes:
        id: unique identifier, e.g. "Scopia#chair".
        name, tags, section: texts in English.
        model: member of the archive that holds the mesh.
        size: width, depth and height, metres.
        rotation: rotation of the mesh axes (x, y up, z to the front) before scaling, nine numbers by rows.
        door_or_window: whether the piece is a door or window, which belongs into a wall.
        creator: author of the model.
        licence: licence of the archive.
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
    def rotation_matrix(self) -> Float[np.ndarray, "3 3"]:
        """Rotation of the mesh axes as a matrix."""
        return np.array(self.rotation).reshape(3, 3)


@dataclass(frozen=True)
class Catalogue:
    """Entries of an archive; `problems` holds the id of each unreadable entry and the reason."""

    path: Path
    entries: tuple[Entry, ...]
    problems: tuple[tuple[str, str], ...]


def read_catalogue(path: Path) -> Catalogue:
    """Read the catalogue of an archive.

    Raises:
        UserError: if the file is not a furniture archive.
    """
    return _read(path.resolve(), _time(path))


@lru_cache(maxsize=32)
def _read(path: Path, _time: int) -> Catalogue:
    with open_archive(path) as archive:
        if PROPERTIES not in archive:
            raise UserError(f"{path}: has no {PROPERTIES}, expected a furniture archive (.sh3f)")
        rows = _rows(archive.lines(PROPERTIES, MAX_TEXT))
        licence = _licence(archive)
    entries, problems = [], []
    for number, row in rows.items():
        try:
            entries.append(_entry(row, licence, path.name))
        except (KeyError, ValueError) as error:
            problems.append((row.get("id", f"entry {number}"), f"invalid catalogue entry: {error!r}"))
    if not entries:
        raise UserError(f"{path}: {PROPERTIES} has no readable furniture entry")
    return Catalogue(path, tuple(entries), tuple(problems))


def names_in_all_languages(path: Path) -> dict[str, set[str]]:
    """Return the lower-case names of each entry in all languages of the archive, by entry id."""
    with open_archive(path) as archive:
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
    """Return the SHA-256 of an archive.

    Raises:
        UserError: if the file cannot be read.
    """
    return _hash(path.resolve(), _time(path))


def _time(path: Path) -> int:
    """Return the modification time of a file, ns; 0 if it does not exist, which the reader then reports."""
    return path.stat().st_mtime_ns if path.is_file() else 0


@lru_cache(maxsize=32)
def _hash(path: Path, _time: int) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from error


def _rows(lines: Iterable[str]) -> dict[int, dict[str, str]]:
    """Return the keys and values of each numbered entry of a Java properties file."""
    rows: dict[int, dict[str, str]] = {}
    for line in lines:
        if match := LINE.match(line):
            text = ESCAPES.sub(_unescaped, match[3]).strip()
            rows.setdefault(int(match[2]), {})[match[1]] = text
    return rows


def _unescaped(escapes: re.Match[str]) -> str:
    return bytes.fromhex(escapes[0].replace("\\u", "")).decode("utf-16-be", "replace")


def _entry(row: dict[str, str], licence: str, archive: str) -> Entry:
    width, depth, height = (float(row[key]) / 100 for key in ("width", "depth", "height"))
    if not all(0 < side < 100 for side in (width, depth, height)):
        raise ValueError(f"size: got {width} x {depth} x {height} m, expected sides in (0, 100) m")
    rotation = tuple(float(value) for value in row.get("modelRotation", "1 0 0 0 1 0 0 0 1").split())
    matrix = np.array(rotation)
    if len(rotation) != 9 or np.abs(matrix.reshape(3, 3) @ matrix.reshape(3, 3).T - np.eye(3)).max() > 1e-2:
        raise ValueError(f"modelRotation: got {rotation}, expected a rotation matrix of nine numbers")
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
    """Return the licence that LICENSE.TXT names, for the credits."""
    text = "".join(archive.read(name, MAX_TEXT).decode("latin-1") for name in _licence_files(archive)).lower()
    united_states = "/by/3.0/us" in text
    if "creative commons zero" in text:
        return "CC0 1.0"
    if "creativecommons.org/licenses/by/3.0" in text:
        return "CC BY 3.0 US" if united_states else "CC BY 3.0"
    return "see the archive's LICENSE.TXT" if text else "unknown"


def _licence_files(archive: Archive) -> Iterator[str]:
    return (name for name in archive if name.upper() == "LICENSE.TXT")
