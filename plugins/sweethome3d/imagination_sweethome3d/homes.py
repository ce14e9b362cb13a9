"""The scene source of homes that people drew: a folder of `.sh3d` files."""

import hashlib
import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from imagination.scenes.building_blocks.assembly import assemble, object_of
from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.building_blocks.pieces import Assembly, Piece, Placed
from imagination.scenes.building_blocks.shapes import box
from imagination.scenes.categories import Category, CategoryTable
from imagination.scenes.free_space import free_space
from imagination.scenes.procedural.source import SOURCE
from imagination.scenes.scene import Lighting, Material, Scene
from imagination.scenes.source import SPLITS, Credit, Split
from imagination.utils.errors import UserError, check_choice
from imagination_sweethome3d.archives import Archive, opened
from imagination_sweethome3d.catalogue import Entry, fingerprint, names_in_all_languages, read_catalogue
from imagination_sweethome3d.furniture import code_version, entry_label, find_archives
from imagination_sweethome3d.home_file import HomePiece, Level, read_home
from imagination_sweethome3d.labels import label_of, label_of_name
from imagination_sweethome3d.models import Model, UnfitError, fitted, read_model
from imagination_sweethome3d.obj import ObjMesh
from imagination_sweethome3d.shell import build_shell

log = logging.getLogger(__name__)

NAME = "sweethome3d"
SHARES = {"test": 0.25, "val": 0.15}
"""Of the files of a folder without folders for its splits."""
MAX_TRIANGLES = 3_000_000
"""Of the models of a level; pieces that come after are drawn as boxes."""
LIGHT = Lighting(
    (0.5, 0.5, 0.5),
    np.array([[0.48, 0.36, 0.8], [-0.6, 0.0, 0.8]], np.float32),
    np.array([[0.34, 0.34, 0.3], [0.15, 0.15, 0.2]], np.float32),
)


class Became(NamedTuple):
    """What a piece of a home became: its label (empty: nothing), what told it, and how it is drawn."""

    piece: HomePiece
    label: str
    told_by: str
    drawn: str


class SweetHomes:
    """Homes of a folder; each furnished level is a scene.

    Args:
        folder: with `.sh3d` files, in folders train, val and test or all together; then they are shared out by name.
        categories: the category table; labels are those of procedural homes.
        robot_radius: metres.
        catalogues: folder with `.sh3f` archives, which tell what pieces are; None looks where the assets are kept.

    Raises:
        UserError: if there is no folder, or it holds no home.
    """

    name = NAME

    def __init__(
        self,
        folder: str | None,
        categories: CategoryTable,
        robot_radius: float,
        catalogues: str | None = None,
    ) -> None:
        if not folder:
            raise UserError(
                "data.scenes.folder: got none, expected one with .sh3d files, in folders train, val and test or all "
                "together"
            )
        self._folder = Path(folder)
        self._categories, self._robot_radius, self._catalogues = categories, robot_radius, catalogues
        if self._folder.is_file():
            raise UserError(f"homes: got the file {folder}, expected a folder that holds it")
        if not any(self._folder.rglob("*.sh3d")):
            raise UserError(
                f"homes: found no .sh3d file in {self._folder.resolve()}"
                f"{'' if self._folder.is_dir() else ', which does not exist'}; set data.scenes.folder to a folder of "
                "homes saved by Sweet Home 3D 5.3 or later, in folders train, val and test or all together"
            )

    def scenes(self, split: Split) -> list[str]:
        """Names of a split's levels: the file's, with the level's number where there are several."""
        check_choice("split", split, SPLITS)
        names = [name for path in self._files()[split] for name in _scenes_of(path)]
        if not names:
            counts = ", ".join(f"{len(paths)} in {key}" for key, paths in self._files().items())
            raise UserError(
                f"split {split}: has no homes ({counts}) in {self._folder}; add files, or make folders train, val "
                "and test"
            )
        return names

    def load(self, scene: str) -> Scene:
        """Build one level.

        Raises:
            UserError: if there is no such scene, its file is broken, or the robot fits nowhere.
        """
        path, level = self._level(scene)
        parts = [Placed(build_shell(level), z=level.elevation)]
        for (piece, *_), made in self._built(path, level):
            z = level.elevation + piece.elevation
            # a piece's frame is turned by half a turn against the plan's: its front is at +y
            parts.append(Placed(made, *piece.centre, piece.yaw + np.pi, z))
        mesh = assemble(parts)
        objects = tuple(
            object_of(number, part, self._category(part.piece.label))
            for number, part in enumerate(parts)
            if number
        )
        try:
            free = free_space(mesh, level.elevation, self._robot_radius)
        except UserError as error:
            raise UserError(f"scene {scene} of {path}: {error}") from error
        ceiling = level.elevation + level.height
        return Scene(scene, mesh, LIGHT, objects, free, level.elevation, ceiling)

    def became(self, scene: str) -> list[Became]:
        """What each piece of a scene became."""
        return [became for became, _ in self._built(*self._level(scene))]

    def _built(self, path: Path, level: Level) -> Iterator[tuple[Became, Piece]]:
        with opened(path) as archive:
            models = _Models(archive)
            for piece in level.furniture:
                label, told_by = self._label(piece)
                made, drawn = _made(models, piece, label)
                yield Became(piece, label, told_by, drawn), made

    def credits(self) -> Sequence[Credit]:
        """Models whose authors a catalogue or the homes themselves name; a home that cannot be read is told."""
        entries, _ = _known(_catalogues(self._catalogues))
        found = set()
        for split, path in self._every():
            try:
                levels = _levels_of(path)
            except UserError as error:
                log.warning("credits: left out a home: %s", error)
                continue
            for piece in (piece for level in levels for piece in level.furniture):
                label = self._label(piece)[0] or piece.name
                if (entry := entries.get(piece.catalogue_id)) is not None:
                    found.add(Credit(split, label, entry.id, entry.creator, entry.licence, entry.archive))
                elif piece.creator:
                    licence = piece.licence or "unknown"
                    found.add(Credit(split, label, piece.key, piece.creator, licence, path.name))
        return sorted(found)

    def fingerprint(self, scene: str) -> str:
        """Changes with the file, the robot, the catalogues, the categories' labels and this code."""
        path, _ = self._level(scene)
        aliases = [
            (row.name, {source: sorted(of) for source, of in row.aliases.items()}) for row in self._categories
        ]
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        archives = [fingerprint(path) for path in _catalogues(self._catalogues)]
        text = repr((NAME, scene, content, self._robot_radius, aliases, archives, code_version()))
        return hashlib.sha256(text.encode()).hexdigest()

    def _files(self) -> dict[Split, list[Path]]:
        return _shared_out(self._folder)

    def _every(self) -> list[tuple[Split, Path]]:
        return [(split, path) for split, paths in self._files().items() for path in paths]

    def _level(self, scene: str) -> tuple[Path, Level]:
        for _, path in self._every():
            if scene.startswith(path.stem) and scene in (names := _scenes_of(path)):
                return path, _levels_of(path)[names.index(scene)]
        known = [name for _, path in self._every() for name in _scenes_of(path)]
        raise UserError(f"scene: got {scene!r}, expected one of: {', '.join(known[:50])}")

    def _category(self, label: str) -> str | None:
        return self._categories.of_label(NAME, label) or self._categories.of_label(SOURCE, label)

    def _label(self, piece: HomePiece) -> tuple[str, str]:
        """A piece's label and what told it: its id, its model, then its name in any language."""
        entries, names = _known(_catalogues(self._catalogues))
        if (entry := entries.get(piece.catalogue_id)) is not None:
            return entry_label(entry) or "", "catalogue"
        for told_by, text in (("id", piece.catalogue_id), ("model", piece.model)):
            if text and (label := label_of([text], piece.size)):
                return label, told_by
        label = label_of_name(piece.name, names, piece.size)
        return (label, "name") if label else ("", "nothing known")


def _scenes_of(path: Path) -> list[str]:
    count = len(_levels_of(path))
    return [path.stem] if count == 1 else [f"{path.stem}_{number}" for number in range(count)]


def _levels_of(path: Path) -> tuple[Level, ...]:
    return _home(path, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=256)
def _home(path: Path, _time: int) -> tuple[Level, ...]:
    return read_home(path)


def _shared_out(folder: Path) -> dict[Split, list[Path]]:
    """Files of each split: by folders, else by a hash of their names."""
    if any((folder / split).is_dir() for split in SPLITS):
        files = {split: sorted((folder / split).rglob("*.sh3d")) for split in SPLITS}
    else:
        mixed = sorted(folder.rglob("*.sh3d"), key=lambda p: hashlib.sha256(p.stem.encode()).hexdigest())
        test = max(round(SHARES["test"] * len(mixed)), int(len(mixed) > 1))
        val = max(round(SHARES["val"] * len(mixed)), int(len(mixed) > 2))
        files = {"train": mixed[test + val :], "val": mixed[test : test + val], "test": mixed[:test]}
    every = [path for paths in files.values() for path in paths]
    by_stem = {path.stem: path for path in every}
    if len(by_stem) < len(every):
        twice = sorted({path.stem for path in every if path != by_stem[path.stem]})
        raise UserError(f"homes: several files in {folder} are called {', '.join(twice)}; rename all but one")
    for stem, path in by_stem.items():  # a level of one home may be called as another home is
        other = by_stem.get(stem.rpartition("_")[0])
        if other is not None and stem in _scenes_of(other) and stem in _scenes_of(path):
            raise UserError(
                f"homes: a level of {other} and {path} are both the scene {stem!r}; rename one of them"
            )
    return files


def _catalogues(folder: str | None) -> tuple[Path, ...]:
    try:
        return find_archives(folder)
    except UserError:
        if folder is not None:
            raise
        return ()  # homes carry their models; catalogues only help to tell what they are


@lru_cache(maxsize=4)
def _known(archives: tuple[Path, ...]) -> tuple[dict[str, Entry], dict[str, str]]:
    """Entries of catalogues by id, and labels by names in all languages; what two labels share tells nothing."""
    entries = {entry.id: entry for path in archives for entry in read_catalogue(path).entries}
    labels: dict[str, set[str]] = {}
    for path in archives:
        for key, names in names_in_all_languages(path).items():
            label = entry_label(entries[key]) if key in entries else None
            for name in names:
                labels.setdefault(name, set()).add(label or "")
    return entries, {name: of.pop() for name, of in labels.items() if len(of) == 1 and "" not in of}


class _Models:
    """The models of one level: each file is read once, however many pieces it is drawn for."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self._meshes: dict[str, ObjMesh | str] = {}
        self._triangles = 0

    def of(self, piece: HomePiece) -> Model:
        """A piece's model.

        Raises:
            UnfitError: if there is none that is sane, or the home has too many triangles already.
        """
        if piece.model not in self._archive:
            raise UnfitError(f"the file does not hold its model {piece.model!r}")
        if self._triangles > MAX_TRIANGLES:
            raise UnfitError(f"the pieces before it have more than {MAX_TRIANGLES} triangles")
        if piece.model not in self._meshes:
            try:
                self._meshes[piece.model] = read_model(self._archive, piece.model)
            except UnfitError as error:
                self._meshes[piece.model] = str(error)
        mesh = self._meshes[piece.model]
        if isinstance(mesh, str):
            raise UnfitError(mesh)
        self._triangles += len(mesh.faces)
        return fitted(mesh, piece.size, np.array(piece.turn).reshape(3, 3))


def _made(models: _Models, piece: HomePiece, label: str) -> tuple[Piece, str]:
    """A piece from its model, else a box of its size, and which of them with the reason."""
    name = label or piece.name or "thing"
    try:
        made, drawn = _modelled(models.of(piece), piece, name), "its model"
    except UnfitError as error:
        solid = Assembly(name, piece.key)
        solid.add(box(*piece.size), Finish(Material(piece.colour or (0.6, 0.58, 0.55))))
        made, drawn = solid.finished(), f"a box: {error}"
    if piece.pitch or piece.roll:
        made = replace(made, vertices=_tilted(made.vertices, piece))
    return made, drawn


def _modelled(model: Model, piece: HomePiece, name: str) -> Piece:
    vertices, faces, uv, finishes = model.vertices, model.faces, model.uv, model.finishes
    if piece.mirrored:
        vertices, faces, uv = vertices * np.array([-1, 1, 1], np.float32), faces[:, ::-1], uv[:, ::-1]
    if piece.colour is not None:
        finishes = (Finish(Material(piece.colour)),) * len(finishes)
    return Piece(name, piece.key, vertices, faces, uv, model.face_finish, finishes)


def _tilted(vertices: Float[np.ndarray, "n 3"], piece: HomePiece) -> Float[np.ndarray, "n 3"]:
    """Turned about the width by the pitch, or about the depth by the roll if there is no pitch; stood up again.

    Elevation and centre are those of the tilted piece, as in Sweet Home 3D's 3D view.
    """
    across, angle = (1, piece.pitch) if piece.pitch else (0, piece.roll)
    cos, sin = np.cos(angle), np.sin(angle)
    tilted = vertices.copy()
    tilted[:, across] = cos * vertices[:, across] - sin * vertices[:, 2]
    tilted[:, 2] = sin * vertices[:, across] + cos * vertices[:, 2]
    low, high = tilted.min(axis=0), tilted.max(axis=0)
    return np.asarray(tilted - [*(low + high)[:2] / 2, low[2]])


def listing_of_homes(folder: Path) -> list[str]:
    """What each piece of the homes in a folder became, a line each.

    Raises:
        UserError: if the folder holds no home, or one is broken.
    """
    homes = SweetHomes(str(folder), CategoryTable([Category("any", (0, 0, 0))]), 0.2)
    lines = []
    for split, paths in _shared_out(folder).items():
        for scene in (name for path in paths for name in _scenes_of(path)):
            lines.append(f"{scene} ({split})")
            for piece, label, told_by, drawn in homes.became(scene):
                name = piece.name or piece.catalogue_id
                lines.append(f"    {name}: {label or 'nothing'} (by {told_by}), drawn as {drawn}")
    return lines
