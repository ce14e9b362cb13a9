"""The scene source of homes that people drew: a folder of `.sh3d` files."""

import hashlib
import logging
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imagination.categories import Category, CategoryTable
from imagination.errors import UserError, check_choice
from imagination.scenes.free_space import free_space
from imagination.scenes.procedural.home import assemble, object_of
from imagination.scenes.procedural.palette import Finish
from imagination.scenes.procedural.pieces import Assembly, Piece, Placed
from imagination.scenes.procedural.shapes import box
from imagination.scenes.procedural.source import SOURCE
from imagination.scenes.scene import SPLITS, Lighting, Material, Scene, Split
from imagination_sweethome3d.archives import Archive, opened
from imagination_sweethome3d.catalogue import Entry, names_in_all_languages, read_catalogue
from imagination_sweethome3d.furniture import code_version, entry_label, find_archives
from imagination_sweethome3d.home_file import HomePiece, Level, read_home
from imagination_sweethome3d.labels import label_of, label_of_name
from imagination_sweethome3d.models import UnfitError, load_model
from imagination_sweethome3d.shell import build_shell

log = logging.getLogger(__name__)

NAME = "sweethome3d"
SHARES = {"test": 0.25, "val": 0.15}
"""Of the files of a folder without folders for its splits."""
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
        UserError: if the folder does not exist or holds no home.
    """

    name = NAME

    def __init__(
        self, folder: str, categories: CategoryTable, robot_radius: float, catalogues: str | None = None
    ) -> None:
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
            UserError: if there is no such scene, or its file is broken.
        """
        path, level = self._level(scene)
        parts, became = [Placed(build_shell(level), z=level.elevation)], []
        with opened(path) as archive:
            for piece in level.furniture:
                label, told_by = self._label(piece)
                made, drawn = _made(archive, piece, label)
                became.append(Became(piece, label, told_by, drawn))
                z = level.elevation + piece.elevation
                # a piece's frame is turned by half a turn against the plan's: its front is at +y
                parts.append(Placed(made, *piece.centre, piece.yaw + np.pi, z))
        mesh = assemble(parts)
        objects = tuple(
            object_of(number, part, self._category(part.piece.label))
            for number, part in enumerate(parts)
            if number
        )
        free = free_space(mesh, level.elevation, self._robot_radius)
        ceiling = level.elevation + level.height
        return Scene(scene, mesh, LIGHT, objects, free, level.elevation, ceiling)

    def became(self, scene: str) -> list[Became]:
        """What each piece of a scene became."""
        path, level = self._level(scene)
        with opened(path) as archive:
            labels = [self._label(piece) for piece in level.furniture]
            return [
                Became(piece, label, told_by, _made(archive, piece, label)[1])
                for piece, (label, told_by) in zip(level.furniture, labels, strict=True)
            ]

    def fingerprint(self, scene: str) -> str:
        """Changes with the file, the robot, the catalogues, the categories' labels and this code."""
        path, _ = self._level(scene)
        members = [
            (row.name, {source: sorted(of) for source, of in row.members.items()}) for row in self._categories
        ]
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        archives = [str(path) for path in _catalogues(self._catalogues)]
        text = repr((NAME, scene, content, self._robot_radius, members, archives, code_version()))
        return hashlib.sha256(text.encode()).hexdigest()

    def _files(self) -> dict[Split, list[Path]]:
        return _shared_out(self._folder)

    def _level(self, scene: str) -> tuple[Path, Level]:
        for paths in self._files().values():
            for path in paths:
                if scene.startswith(path.stem) and scene in (names := _scenes_of(path)):
                    return path, _home(path, path.stat().st_mtime_ns)[names.index(scene)]
        known = [name for paths in self._files().values() for path in paths for name in _scenes_of(path)]
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
    levels = _home(path, path.stat().st_mtime_ns)
    return [path.stem] if len(levels) == 1 else [f"{path.stem}_{number}" for number in range(len(levels))]


@lru_cache(maxsize=256)
def _home(path: Path, _time: int) -> tuple[Level, ...]:
    return read_home(path)


def _shared_out(folder: Path) -> dict[Split, list[Path]]:
    """Files of each split: by folders, else by a hash of their names."""
    if any((folder / split).is_dir() for split in SPLITS):
        files = {split: sorted((folder / split).rglob("*.sh3d")) for split in SPLITS}
    else:
        every = sorted(folder.rglob("*.sh3d"), key=lambda p: hashlib.sha256(p.stem.encode()).hexdigest())
        test = max(round(SHARES["test"] * len(every)), int(len(every) > 1))
        val = max(round(SHARES["val"] * len(every)), int(len(every) > 2))
        files = {"train": every[test + val :], "val": every[test : test + val], "test": every[:test]}
    stems = [path.stem for paths in files.values() for path in paths]
    if twice := sorted({stem for stem in stems if stems.count(stem) > 1}):
        raise UserError(f"homes: several files in {folder} are called {', '.join(twice)}; rename all but one")
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


def _made(archive: Archive, piece: HomePiece, label: str) -> tuple[Piece, str]:
    """A piece from its model, else a box of its size, and which of them with the reason."""
    name = label or piece.name or "thing"
    key = piece.catalogue_id or piece.model or piece.name
    try:
        if piece.model not in archive:
            raise UnfitError(f"the file does not hold its model {piece.model!r}")
        turn = np.array(piece.turn).reshape(3, 3)
        model = load_model(archive, piece.model, piece.size, turn)
    except UnfitError as error:
        solid = Assembly(name, key)
        solid.add(box(*piece.size), Finish(Material(piece.colour or (0.6, 0.58, 0.55))))
        return solid.finished(), f"a box: {error}"
    vertices, faces = model.vertices, model.faces
    if piece.mirrored:
        vertices, faces = vertices * np.array([-1, 1, 1], np.float32), faces[:, ::-1]
    uv = model.uv[:, ::-1] if piece.mirrored else model.uv
    finishes = model.finishes
    if piece.colour is not None:
        finishes = (Finish(Material(piece.colour)),) * len(finishes)
    return Piece(name, key, vertices, faces, uv, model.face_finish, finishes), "its model"


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
