"""Furniture of procedural homes from Sweet Home 3D's catalogues, split by model."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imagination.scenes.building_blocks.palette import Finish, Palette
from imagination.scenes.building_blocks.pieces import Piece, Seat, Surface
from imagination.scenes.procedural.furniture.stock import STYLED, ProceduralFurniture
from imagination.scenes.scene import Material
from imagination.scenes.source import SPLITS, Credit, Split
from imagination.utils.cache import Cache
from imagination.utils.errors import UserError
from imagination_sweethome3d.archives import opened
from imagination_sweethome3d.catalogue import Catalogue, Entry, fingerprint, read_catalogue
from imagination_sweethome3d.labels import label_of, only_sounds
from imagination_sweethome3d.models import SIZES, UnfitError, check_size, fitted, read_model
from imagination_sweethome3d.seats import corners_of, seats_and_surfaces

INSTALLED = Path("/usr/share/sweethome3d/furniture")
"""Where Debian's package sweethome3d-furniture puts its archives."""
VARIABLE = "IMAGINATION_ASSETS"
SHARES: Mapping[Split, float] = {"train": 0.6, "val": 0.15, "test": 0.25}
"""Of the designs of each label."""
ALIKE = 0.02
"""Designs whose sizes differ by less than this share on every axis count as one."""


class Candidate(NamedTuple):
    """A catalogue's entry, what it is called here, and why it is left out (empty: it is used)."""

    entry: Entry
    label: str
    reason: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class SweetHomeFurniture:
    """Designed models where there are some of a label, procedural pieces else.

    Attributes:
        folder: with `.sh3f` archives; None looks in $IMAGINATION_ASSETS and where Debian installs them.
        cache: keeps models made ready.
    """

    folder: str | None
    cache: Cache

    def piece(self, label: str, split: Split, palette: Palette, rng: np.random.Generator) -> Piece:
        """A model of the split with this label, any as likely as another.

        Raises:
            UserError: if there are no archives.
        """
        entries = self._designs().get((label, split), ())
        if not entries:
            return ProceduralFurniture().piece(label, split, palette, rng)
        return self._piece(label, entries[int(rng.integers(len(entries)))])

    def fingerprint(self) -> str:
        """Changes with the archives and this code."""
        parts = [fingerprint(path) for path in find_archives(self.folder)]
        return hashlib.sha256(" ".join([*parts, code_version()]).encode()).hexdigest()

    def credits(self) -> Sequence[Credit]:
        """Every model that homes may hold, with its author and licence."""
        return [
            Credit(split, label, entry.id, entry.creator, entry.licence, entry.archive)
            for (label, split), entries in sorted(self._designs().items())
            for entry in entries
        ]

    def _designs(self) -> dict[tuple[str, Split], tuple[Entry, ...]]:
        return _designs(find_archives(self.folder), self.cache)

    def _piece(self, label: str, entry: Entry) -> Piece:
        path = next(path for path in find_archives(self.folder) if path.name == entry.archive)
        return _prepared(path, label, entry, self.cache)


def find_archives(folder: str | None = None) -> tuple[Path, ...]:
    """The furniture archives, in a fixed order.

    Raises:
        UserError: if there are none, with the places looked at.
    """
    asked = [Path(folder)] if folder else [Path(place) for place in _places()]
    for place in asked:
        if found := sorted(place.rglob("*.sh3f")):
            return tuple(found)
    raise UserError(
        f"furniture of Sweet Home 3D: found no .sh3f archive in {' or '.join(map(str, asked))}; run "
        f"`python -m imagination.assets sweethome3d`, or set {VARIABLE} to a folder that holds some"
    )


def _places() -> list[str]:
    given = os.environ.get(VARIABLE)
    return [*([given] if given else []), str(assets_folder()), str(INSTALLED)]


def assets_folder() -> Path:
    """Where `python -m imagination.assets` puts what it fetches: $IMAGINATION_ASSETS, else the user's data folder."""
    if given := os.environ.get(VARIABLE):
        return Path(given)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "imagination" / "assets"


def candidates(archives: Sequence[Path], cache: Cache) -> list[Candidate]:
    """Every entry of the archives that is furniture, or is called like some, with the reason if it is left out."""
    found = []
    for path in archives:
        catalogue: Catalogue = read_catalogue(path)
        for entry in catalogue.entries:
            label = entry_label(entry)
            if label in SIZES:
                found.append(_examined(path, label, entry, cache))
            elif label is not None:
                found.append(Candidate(entry, label, f"our floor plans have no {label}"))
            elif only_sounds([entry.name, entry.id]):
                found.append(Candidate(entry, "?", "it is only called like furniture"))
    return found


def entry_label(entry: Entry) -> str | None:
    """What a catalogue's entry is, None if it is no furniture that is known here."""
    if entry.door_or_window or entry.section in ("Characters", "Vehicles", "Doors and windows"):
        return None
    return label_of([entry.name, entry.id], entry.size)


def _examined(path: Path, label: str, entry: Entry, cache: Cache) -> Candidate:
    try:
        check_size(label, entry.size)
        return Candidate(entry, label, "", _told(_arrays(path, label, entry, cache))[1])
    except UnfitError as error:
        return Candidate(entry, label, str(error))


@lru_cache(maxsize=4)
def _designs(archives: tuple[Path, ...], cache: Cache) -> dict[tuple[str, Split], tuple[Entry, ...]]:
    """The models of each label and split, without those left out."""
    fit: dict[str, list[Entry]] = {}
    for candidate in candidates(archives, cache):
        if not candidate.reason:
            fit.setdefault(candidate.label, []).append(candidate.entry)
    if not set(fit) & set(STYLED):
        raise UserError(
            f"furniture of Sweet Home 3D: no chair, table or bed in {', '.join(map(str, archives))} is fit for use; "
            "`python -m imagination.assets sweethome3d list=true` tells why"
        )
    designs: dict[tuple[str, Split], tuple[Entry, ...]] = {}
    for label, entries in fit.items():
        for split, group in split_designs(entries).items():
            designs[label, split] = tuple(group)
    return designs


def split_designs(entries: Sequence[Entry]) -> dict[Split, list[Entry]]:
    """Entries of one label shared out among the splits; what looks alike stays together.

    Each split gets its share of the designs in an order that depends on their ids alone; of two designs one is for
    training and one for test, and one alone is for training.
    """
    groups: list[list[Entry]] = []
    for entry in sorted(entries, key=lambda entry: entry.id):
        alike = next((group for group in groups if any(_alike(entry, other) for other in group)), None)
        if alike is None:
            groups.append([entry])
        else:
            alike.append(entry)
    groups.sort(key=lambda group: hashlib.sha256(group[0].id.encode()).hexdigest())
    count = len(groups)
    test = max(round(SHARES["test"] * count), int(count > 1))
    val = max(round(SHARES["val"] * count), int(count > 2))
    ends: dict[Split, list[list[Entry]]] = {
        "test": groups[:test],
        "val": groups[test : test + val],
        "train": groups[test + val :],
    }
    return {split: [entry for group in ends[split] for entry in group] for split in SPLITS if ends[split]}


def _alike(first: Entry, second: Entry) -> bool:
    return bool(np.allclose(sorted(first.size), sorted(second.size), rtol=ALIKE, atol=0))


@lru_cache(maxsize=256)
def _prepared(path: Path, label: str, entry: Entry, cache: Cache) -> Piece:
    """An entry as a piece, made once in each process."""
    arrays = _arrays(path, label, entry, cache)
    colours, finishes = arrays["colours"], []
    for row, (red, green, blue) in enumerate(colours.tolist()):
        finishes.append(Finish(Material((red, green, blue), arrays.get(f"texture_{row}"))))
    return Piece(
        label,
        entry.id,
        arrays["vertices"],
        arrays["faces"],
        arrays["uv"],
        arrays["face_finish"],
        tuple(finishes),
        tuple(Seat(*row) for row in arrays["seats"].tolist()),
        tuple(Surface(*row) for row in arrays["surfaces"].tolist()),
    )


def _arrays(path: Path, label: str, entry: Entry, cache: Cache) -> dict[str, np.ndarray]:
    """An entry's model as arrays, from the cache where it was made ready before.

    Raises:
        UnfitError: if it is not sane; this is kept as well.
    """
    key = {"archive": fingerprint(path), "entry": entry.id, "label": label, "code": code_version()}
    arrays = cache.get_or_build("models", key, lambda: _made(path, label, entry))
    if reason := _told(arrays)[0]:
        raise UnfitError(reason)
    return arrays


def _telling(reason: str, notes: Sequence[str]) -> np.ndarray:
    """Text as an array that the cache keeps: why a model is left out (empty: it is not), and what it lacks."""
    return np.frombuffer(json.dumps([reason, *notes]).encode(), np.uint8)


def _told(arrays: Mapping[str, np.ndarray]) -> tuple[str, tuple[str, ...]]:
    reason, *notes = json.loads(arrays["told"].tobytes())
    return reason, tuple(notes)


def _made(path: Path, label: str, entry: Entry) -> dict[str, np.ndarray]:
    try:
        with opened(path) as archive:
            model = fitted(read_model(archive, entry.model), entry.size, entry.turn)
    except UnfitError as error:
        return {"told": _telling(str(error), ())}
    seats, surfaces = seats_and_surfaces(label, corners_of(model.vertices, model.faces))
    textures = {
        f"texture_{row}": finish.material.texture
        for row, finish in enumerate(model.finishes)
        if finish.material.texture is not None
    }
    return {
        "told": _telling("", model.notes),
        "vertices": model.vertices,
        "faces": model.faces,
        "uv": model.uv,
        "face_finish": model.face_finish,
        "colours": np.array([finish.material.colour for finish in model.finishes]),
        "seats": np.array(seats, np.float64).reshape(-1, len(Seat._fields)),
        "surfaces": np.array(surfaces, np.float64).reshape(-1, len(Surface._fields)),
        **textures,
    }


@lru_cache(maxsize=1)
def code_version() -> str:
    """Hash of this plugin's code: what it made before is made again after a change."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
