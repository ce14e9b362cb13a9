"""Furniture source with models from the catalogues of Sweet Home 3D, split by design."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imagination.scenes.building_blocks.furniture_source import STYLED_LABELS
from imagination.scenes.building_blocks.palette import Finish, Palette
from imagination.scenes.building_blocks.pieces import Piece, Seat, Surface
from imagination.scenes.scene import Material
from imagination.scenes.source import SPLITS, Credit, Split
from imagination.utils.cache import Cache
from imagination.utils.code_hash import module_hash
from imagination.utils.errors import UserError
from imagination_sweethome3d.archives import open_archive
from imagination_sweethome3d.catalogue import Catalogue, Entry, fingerprint, read_catalogue
from imagination_sweethome3d.labels import label_of, only_named_like_furniture
from imagination_sweethome3d.models import SIZES, UnfitError, check_size, fit_model, read_model
from imagination_sweethome3d.seats import corners_of, seats_and_surfaces

INSTALLED = Path("/usr/share/sweethome3d/furniture")
"""Folder of the archives of Debian's package sweethome3d-furniture."""
VARIABLE = "IMAGINATION_ASSETS"
"""Environment variable with the assets folder."""
SPLIT_FRACTIONS: Mapping[Split, float] = {"train": 0.6, "val": 0.15, "test": 0.25}
"""Fraction of the designs of each label in each split."""
SIZE_TOLERANCE = 0.02
"""Relative difference on every axis below which two entries count as one design."""


class Candidate(NamedTuple):
    """Catalogue entry with its label, the reason if it is left out (else empty), and notes on its model."""

    entry: Entry
    label: str
    reason: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class SweetHomeFurniture:
    """Furniture source of catalogue models; labels without a model are left to the procedural furniture.

    Attributes:
        folder: folder of `.sh3f` archives; None searches $IMAGINATION_ASSETS and the folder of Debian's package.
        cache: cache of prepared models.
    """

    folder: str | None
    cache: Cache

    def piece(self, label: str, split: Split, palette: Palette, rng: np.random.Generator) -> Piece | None:
        """Draw a model of the split with this label uniformly; return None if there is no such model.

        Raises:
            UserError: if there are no archives.
        """
        entries = self._designs().get((label, split), ())
        if not entries:
            return None
        return self._piece(label, entries[int(rng.integers(len(entries)))])

    def fingerprint(self) -> str:
        """Return a hash of the archives."""
        parts = [fingerprint(path) for path in find_archives(self.folder)]
        return hashlib.sha256(" ".join(parts).encode()).hexdigest()

    def credits(self) -> Sequence[Credit]:
        """Return all models in use with their authors and licences."""
        return [
            Credit(split, label, entry.id, entry.creator, entry.licence, entry.archive)
            for (label, split), entries in sorted(self._designs().items())
            for entry in entries
        ]

    def _designs(self) -> dict[tuple[str, Split], tuple[Entry, ...]]:
        return _designs(find_archives(self.folder), self.cache)

    def _piece(self, label: str, entry: Entry) -> Piece:
        path = next(path for path in find_archives(self.folder) if path.name == entry.archive)
        return _load_piece(path, label, entry, self.cache)


def find_archives(folder: str | None = None) -> tuple[Path, ...]:
    """Return the furniture archives in a fixed order.

    Raises:
        UserError: if there are none; the message names the folders searched.
    """
    folders = [Path(folder)] if folder else _default_folders()
    for place in folders:
        if archives := sorted(place.rglob("*.sh3f")):
            return tuple(archives)
    raise UserError(
        f"furniture of Sweet Home 3D: found no .sh3f archive in {' or '.join(map(str, folders))}; run "
        f"`python -m imagination.assets name=sweethome3d`, or set {VARIABLE} to a folder of archives"
    )


def _default_folders() -> list[Path]:
    variable = os.environ.get(VARIABLE)
    return [*([Path(variable)] if variable else []), assets_folder(), INSTALLED]


def assets_folder() -> Path:
    """Return the target folder of `python -m imagination.assets`: $IMAGINATION_ASSETS, else the user's data folder."""
    if variable := os.environ.get(VARIABLE):
        return Path(variable)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "imagination" / "assets"


def candidates(archives: Sequence[Path], cache: Cache) -> list[Candidate]:
    """Return all entries that are furniture or named like furniture, with the reason if they are left out."""
    furniture = []
    for path in archives:
        catalogue: Catalogue = read_catalogue(path)
        for entry in catalogue.entries:
            label = entry_label(entry)
            if label in SIZES:
                furniture.append(_check_entry(path, label, entry, cache))
            elif label is not None:
                furniture.append(Candidate(entry, label, f"procedural homes have no label {label}"))
            elif only_named_like_furniture([entry.name, entry.id]):
                furniture.append(Candidate(entry, "?", "only its name resembles furniture"))
    return furniture


def entry_label(entry: Entry) -> str | None:
    """Return the label of a catalogue entry, or None if it is not furniture of a known label."""
    if entry.door_or_window or entry.section in ("Characters", "Vehicles", "Doors and windows"):
        return None
    return label_of([entry.name, entry.id], entry.size)


def _check_entry(path: Path, label: str, entry: Entry, cache: Cache) -> Candidate:
    try:
        check_size(label, entry.size)
        return Candidate(entry, label, "", _decode_report(_load_arrays(path, label, entry, cache))[1])
    except UnfitError as error:
        return Candidate(entry, label, str(error))


@lru_cache(maxsize=4)
def _designs(archives: tuple[Path, ...], cache: Cache) -> dict[tuple[str, Split], tuple[Entry, ...]]:
    """Return the usable models of each label and split."""
    usable: dict[str, list[Entry]] = {}
    for candidate in candidates(archives, cache):
        if not candidate.reason:
            usable.setdefault(candidate.label, []).append(candidate.entry)
    if not set(usable) & set(STYLED_LABELS):
        raise UserError(
            f"furniture of Sweet Home 3D: no chair, table or bed in {', '.join(map(str, archives))} can be used; "
            "`python -m imagination.assets name=sweethome3d list=true` lists the reasons"
        )
    designs: dict[tuple[str, Split], tuple[Entry, ...]] = {}
    for label, entries in usable.items():
        for split, group in split_designs(entries).items():
            designs[label, split] = tuple(group)
    return designs


def split_designs(entries: Sequence[Entry]) -> dict[Split, list[Entry]]:
    """Assign the entries of one label to splits; entries of one design stay together.

    The order of the designs depends on their ids alone, and each split gets its SPLIT_FRACTIONS of them. Of two designs
    one is for training and one for test; a single design is for training.
    """
    groups: list[list[Entry]] = []
    for entry in sorted(entries, key=lambda entry: entry.id):
        design = next((group for group in groups if any(_same_size(entry, other) for other in group)), None)
        if design is None:
            groups.append([entry])
        else:
            design.append(entry)
    groups.sort(key=lambda group: hashlib.sha256(group[0].id.encode()).hexdigest())
    count = len(groups)
    test = max(round(SPLIT_FRACTIONS["test"] * count), int(count > 1))
    val = max(round(SPLIT_FRACTIONS["val"] * count), int(count > 2))
    designs: dict[Split, list[list[Entry]]] = {
        "test": groups[:test],
        "val": groups[test : test + val],
        "train": groups[test + val :],
    }
    return {
        split: [entry for group in designs[split] for entry in group] for split in SPLITS if designs[split]
    }


def _same_size(first: Entry, second: Entry) -> bool:
    return bool(np.allclose(sorted(first.size), sorted(second.size), rtol=SIZE_TOLERANCE, atol=0))


@lru_cache(maxsize=256)
def _load_piece(path: Path, label: str, entry: Entry, cache: Cache) -> Piece:
    """Return an entry as a piece, loaded once in each process."""
    arrays = _load_arrays(path, label, entry, cache)
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


def _load_arrays(path: Path, label: str, entry: Entry, cache: Cache) -> dict[str, np.ndarray]:
    """Return the arrays of a prepared model, from the cache if it holds them.

    Raises:
        UnfitError: if the model is invalid; the reason is cached as well.
    """
    key = {"archive": fingerprint(path), "entry": entry.id, "label": label, "code": module_hash(__name__)}
    arrays = cache.get_or_build("models", key, lambda: _prepare_arrays(path, label, entry))
    if reason := _decode_report(arrays)[0]:
        raise UnfitError(reason)
    return arrays


def _encode_report(reason: str, notes: Sequence[str]) -> np.ndarray:
    """Encode the reason why a model is left out (empty if it is used) and notes on it as an array for the cache."""
    return np.frombuffer(json.dumps([reason, *notes]).encode(), np.uint8)


def _decode_report(arrays: Mapping[str, np.ndarray]) -> tuple[str, tuple[str, ...]]:
    reason, *notes = json.loads(arrays["report"].tobytes())
    return reason, tuple(notes)


def _prepare_arrays(path: Path, label: str, entry: Entry) -> dict[str, np.ndarray]:
    try:
        with open_archive(path) as archive:
            model = fit_model(read_model(archive, entry.model), entry.size, entry.rotation_matrix)
    except UnfitError as error:
        return {"report": _encode_report(str(error), ())}
    seats, surfaces = seats_and_surfaces(label, corners_of(model.vertices, model.faces))
    textures = {
        f"texture_{row}": finish.material.texture
        for row, finish in enumerate(model.finishes)
        if finish.material.texture is not None
    }
    return {
        "report": _encode_report("", model.notes),
        "vertices": model.vertices,
        "faces": model.faces,
        "uv": model.uv,
        "face_finish": model.face_finish,
        "colours": np.array([finish.material.colour for finish in model.finishes]),
        "seats": np.array(seats, np.float64).reshape(-1, len(Seat._fields)),
        "surfaces": np.array(surfaces, np.float64).reshape(-1, len(Surface._fields)),
        **textures,
    }
