"""Scene source of homes drawn in Sweet Home 3D: a folder of `.sh3d` files."""

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
from imagination.scenes.building_blocks.furniture_source import SOURCE
from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.building_blocks.pieces import Assembly, Piece, Placed
from imagination.scenes.building_blocks.shapes import box
from imagination.scenes.categories import Category, CategoryTable
from imagination.scenes.free_space import free_space
from imagination.scenes.scene import Lighting, Material, Scene
from imagination.scenes.source import SPLITS, Credit, Split
from imagination.utils.errors import UserError, check_choice
from imagination_sweethome3d.archives import Archive, open_archive
from imagination_sweethome3d.catalogue import Entry, fingerprint, names_in_all_languages, read_catalogue
from imagination_sweethome3d.furniture import entry_label, find_archives
from imagination_sweethome3d.home_file import HomePiece, Level, read_home
from imagination_sweethome3d.labels import label_of, label_of_name
from imagination_sweethome3d.models import Model, UnfitError, fit_model, read_model
from imagination_sweethome3d.obj import ObjMesh
from imagination_sweethome3d.shell import build_shell

log = logging.getLogger(__name__)

NAME = "sweethome3d"
SPLIT_FRACTIONS = {"test": 0.25, "val": 0.15}
"""Fractions of the files in the test and val splits if the folder has no subfolders for splits; train gets the rest."""
MAX_TRIANGLES = 3_000_000
"""Maximum number of triangles in the models of a level; further pieces become boxes."""
LIGHT = Lighting(
    (0.5, 0.5, 0.5),
    np.array([[0.48, 0.36, 0.8], [-0.6, 0.0, 0.8]], np.float32),
    np.array([[0.34, 0.34, 0.3], [0.15, 0.15, 0.2]], np.float32),
)


class PieceReport(NamedTuple):
    """Interpretation of a piece of a home.

    Attributes:
        piece: piece as the file describes it.
        label: label of the piece, empty if unknown.
        label_source: attribute that the label was derived from.
        drawn_as: its model, or a box with the reason.
    """

    piece: HomePiece
    label: str
    label_source: str
    drawn_as: str


class SweetHomes:
    """Scene source of the homes in a folder; each furnished level is a scene.

    Args:
        folder: folder of `.sh3d` files. Its subfolders train, val and test are the splits; without these subfolders the
            files are split by a hash of their names.
        categories: category table; labels are those of procedural homes.
        robot_radius: radius of the robot, metres.
        catalogues: folder of `.sh3f` archives, from which labels of pieces are derived; None searches the assets.

    Raises:
        UserError: if the folder does not exist, or holds no home.
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
                "data.scenes.folder: got null, expected a folder of .sh3d files, optionally with subfolders train, val "
                "and test"
            )
        self._folder = Path(folder)
        self._categories, self._robot_radius, self._catalogues = categories, robot_radius, catalogues
        if self._folder.is_file():
            raise UserError(
                f"data.scenes.folder: got the file {folder}, expected the folder that contains it"
            )
        if not any(self._folder.rglob("*.sh3d")):
            raise UserError(
                f"data.scenes.folder: found no .sh3d file in {self._folder.resolve()}"
                f"{'' if self._folder.is_dir() else ', which does not exist'}; expected a folder of homes saved by "
                "Sweet Home 3D 5.3 or later, optionally with subfolders train, val and test"
            )

    def scenes(self, split: Split) -> list[str]:
        """Return the names of a split's levels: the file name, with the number of the level if there are several."""
        check_choice("split", split, SPLITS)
        names = [name for path in self._files()[split] for name in _scenes_of(path)]
        if not names:
            counts = ", ".join(f"{len(paths)} in {key}" for key, paths in self._files().items())
            raise UserError(
                f"split {split}: found no homes in {self._folder} ({counts}); add files, or sort them into subfolders "
                "train, val and test"
            )
        return names

    def load(self, scene: str) -> Scene:
        """Build the scene of one level.

        Raises:
            UserError: if the scene does not exist, its file is invalid, or it has no free space for the robot.
        """
        path, level = self._level(scene)
        parts = [Placed(build_shell(level), z=level.elevation)]
        for report, model in self._pieces(path, level):
            piece = report.piece
            z = level.elevation + piece.elevation
            # the front of a `Piece` is at +y, that of a piece in a home at -y
            parts.append(Placed(model, *piece.centre, piece.yaw + np.pi, z))
        mesh = assemble(parts)
        objects = tuple(
            object_of(index, part, self._category(part.piece.label))
            for index, part in enumerate(parts)
            if index  # part 0 is the shell of the level
        )
        try:
            free = free_space(mesh, level.elevation, self._robot_radius)
        except UserError as error:
            raise UserError(f"scene {scene} of {path}: {error}") from error
        ceiling = level.elevation + level.height
        return Scene(scene, mesh, LIGHT, objects, free, level.elevation, ceiling)

    def piece_reports(self, scene: str) -> list[PieceReport]:
        """Return the label and model of each piece of a scene."""
        return [report for report, _ in self._pieces(*self._level(scene))]

    def _pieces(self, path: Path, level: Level) -> Iterator[tuple[PieceReport, Piece]]:
        """Yield the furniture of a level, as described in the home and as built."""
        with open_archive(path) as archive:
            models = _Models(archive)
            for piece in level.furniture:
                label, label_source = self._label(piece)
                model, drawn_as = _build_piece(models, piece, label)
                yield PieceReport(piece, label, label_source, drawn_as), model

    def credits(self) -> Sequence[Credit]:
        """Return the credits of models whose author a catalogue or a home names; log and skip unreadable homes."""
        entries, _ = _known(_catalogues(self._catalogues))
        credits = set()
        for split, path in self._all_files():
            try:
                levels = _levels_of(path)
            except UserError as error:
                log.warning("credits: skipped a home: %s", error)
                continue
            for piece in (piece for level in levels for piece in level.furniture):
                label = self._label(piece)[0] or piece.name
                if (entry := entries.get(piece.catalogue_id)) is not None:
                    credits.add(Credit(split, label, entry.id, entry.creator, entry.licence, entry.archive))
                elif piece.creator:
                    licence = piece.licence or "unknown"
                    credits.add(Credit(split, label, piece.key, piece.creator, licence, path.name))
        return sorted(credits)

    def identity(self, scene: str) -> str:
        """Return the name of a level, whatever the split of its file."""
        return f"{NAME} {scene}"

    def fingerprint(self, scene: str) -> str:
        """Return a hash of the file, robot radius, catalogues and category aliases."""
        path, _ = self._level(scene)
        aliases = [
            (row.name, {source: sorted(labels) for source, labels in row.aliases.items()})
            for row in self._categories
        ]
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        archives = [fingerprint(path) for path in _catalogues(self._catalogues)]
        text = repr((NAME, scene, content, self._robot_radius, aliases, archives))
        return hashlib.sha256(text.encode()).hexdigest()

    def _files(self) -> dict[Split, list[Path]]:
        return _split_files(self._folder)

    def _all_files(self) -> list[tuple[Split, Path]]:
        return [(split, path) for split, paths in self._files().items() for path in paths]

    def _level(self, scene: str) -> tuple[Path, Level]:
        """Return the file of a scene and its level in that file.

        Raises:
            UserError: if there is no such scene.
        """
        for _, path in self._all_files():
            if scene.startswith(path.stem) and scene in (names := _scenes_of(path)):
                return path, _levels_of(path)[names.index(scene)]
        known = [name for _, path in self._all_files() for name in _scenes_of(path)]
        raise UserError(f"scene: got {scene!r}, expected one of: {', '.join(known[:50])}")

    def _category(self, label: str) -> str | None:
        return self._categories.of_label(NAME, label) or self._categories.of_label(SOURCE, label)

    def _label(self, piece: HomePiece) -> tuple[str, str]:
        """Return the label of a piece and its source: the catalogue, the id, the model, or the name in any language."""
        entries, names = _known(_catalogues(self._catalogues))
        if (entry := entries.get(piece.catalogue_id)) is not None:
            return entry_label(entry) or "", "catalogue"
        for source, text in (("id", piece.catalogue_id), ("model", piece.model)):
            if text and (label := label_of([text], piece.size)):
                return label, source
        label = label_of_name(piece.name, names, piece.size)
        return (label, "name") if label else ("", "no known attribute")


def _scenes_of(path: Path) -> list[str]:
    """Return the names of the scenes in a file."""
    count = len(_levels_of(path))
    return [path.stem] if count == 1 else [f"{path.stem}_{number}" for number in range(count)]


def _levels_of(path: Path) -> tuple[Level, ...]:
    return _home(path, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=256)
def _home(path: Path, _time: int) -> tuple[Level, ...]:
    """Return the levels of a home, read again if the modification time of the file changes."""
    return read_home(path)


def _split_files(folder: Path) -> dict[Split, list[Path]]:
    """Return the files of each split: by subfolder, or by a hash of their names if there are no subfolders."""
    if any((folder / split).is_dir() for split in SPLITS):
        files = {split: sorted((folder / split).rglob("*.sh3d")) for split in SPLITS}
    else:
        by_hash = sorted(folder.rglob("*.sh3d"), key=lambda p: hashlib.sha256(p.stem.encode()).hexdigest())
        test = max(round(SPLIT_FRACTIONS["test"] * len(by_hash)), int(len(by_hash) > 1))
        val = max(round(SPLIT_FRACTIONS["val"] * len(by_hash)), int(len(by_hash) > 2))
        files = {"train": by_hash[test + val :], "val": by_hash[test : test + val], "test": by_hash[:test]}
    homes = [path for paths in files.values() for path in paths]
    by_stem = {path.stem: path for path in homes}
    if len(by_stem) < len(homes):
        duplicates = sorted({path.stem for path in homes if path != by_stem[path.stem]})
        raise UserError(
            f"homes: got several files named {', '.join(duplicates)} in {folder}, expected distinct names; rename them"
        )
    for stem, path in by_stem.items():  # level 1 of a.sh3d is named a_1, which may also be a file
        other = by_stem.get(stem.rpartition("_")[0])
        if other is not None and stem in _scenes_of(other) and stem in _scenes_of(path):
            raise UserError(
                f"homes: got the scene name {stem!r} for a level of {other} and for {path}; rename one of the files"
            )
    return files


def _catalogues(folder: str | None) -> tuple[Path, ...]:
    """Return the catalogues in a folder, or those among the assets, if any."""
    try:
        return find_archives(folder)
    except UserError:
        if folder is not None:
            raise
        return ()  # optional: homes contain their models, and catalogues only provide labels


@lru_cache(maxsize=4)
def _known(archives: tuple[Path, ...]) -> tuple[dict[str, Entry], dict[str, str]]:
    """Return catalogue entries by id, and labels by name in any language; ambiguous names are left out."""
    entries = {entry.id: entry for path in archives for entry in read_catalogue(path).entries}
    labels: dict[str, set[str]] = {}
    for path in archives:
        for key, names in names_in_all_languages(path).items():
            label = entry_label(entries[key]) if key in entries else None
            for name in names:
                labels.setdefault(name, set()).add(label or "")
    unambiguous = {name: found for name, found in labels.items() if len(found) == 1 and "" not in found}
    return entries, {name: found.pop() for name, found in unambiguous.items()}


class _Models:
    """Loader of the models of one level; a model that several pieces share is read once."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self._meshes: dict[str, ObjMesh | str] = {}
        self._triangles = 0

    def fit(self, piece: HomePiece) -> Model:
        """Return the model of a piece, fitted to its size.

        Raises:
            UnfitError: if the model is missing or invalid, or the level has more than MAX_TRIANGLES already.
        """
        if piece.model not in self._archive:
            raise UnfitError(f"the file does not contain the model {piece.model!r}")
        if self._triangles > MAX_TRIANGLES:
            raise UnfitError(f"earlier pieces of the level have more than {MAX_TRIANGLES} triangles")
        if piece.model not in self._meshes:
            try:
                self._meshes[piece.model] = read_model(self._archive, piece.model)
            except UnfitError as error:
                self._meshes[piece.model] = str(error)
        mesh = self._meshes[piece.model]
        if isinstance(mesh, str):
            raise UnfitError(mesh)
        self._triangles += len(mesh.faces)
        return fit_model(mesh, piece.size, np.array(piece.model_rotation).reshape(3, 3))


def _build_piece(models: _Models, piece: HomePiece, label: str) -> tuple[Piece, str]:
    """Return a piece with its model, or as a box of its size if the model is unfit, and the text for `drawn_as`."""
    name = label or piece.name or "thing"
    try:
        built, drawn_as = _with_model(models.fit(piece), piece, name), "its model"
    except UnfitError as error:
        solid = Assembly(name, piece.key)
        solid.add(box(*piece.size), Finish(Material(piece.colour or (0.6, 0.58, 0.55))))
        built, drawn_as = solid.finished(), f"a box: {error}"
    if piece.pitch or piece.roll:
        built = replace(built, vertices=_tilt(built.vertices, piece))
    return built, drawn_as


def _with_model(model: Model, piece: HomePiece, name: str) -> Piece:
    vertices, faces, uv, finishes = model.vertices, model.faces, model.uv, model.finishes
    if piece.mirrored:
        vertices, faces, uv = vertices * np.array([-1, 1, 1], np.float32), faces[:, ::-1], uv[:, ::-1]
    if piece.colour is not None:
        finishes = (Finish(Material(piece.colour)),) * len(finishes)
    return Piece(name, piece.key, vertices, faces, uv, model.face_finish, finishes)


def _tilt(vertices: Float[np.ndarray, "n 3"], piece: HomePiece) -> Float[np.ndarray, "n 3"]:
    """Rotate vertices about the width axis by the pitch, or about the depth axis by the roll if there is no pitch.

    The result is centred horizontally and stands on the floor, because a home holds the elevation and centre of the
    tilted piece.
    """
    across, angle = (1, piece.pitch) if piece.pitch else (0, piece.roll)
    cos, sin = np.cos(angle), np.sin(angle)
    tilted = vertices.copy()
    tilted[:, across] = cos * vertices[:, across] - sin * vertices[:, 2]
    tilted[:, 2] = sin * vertices[:, across] + cos * vertices[:, 2]
    low, high = tilted.min(axis=0), tilted.max(axis=0)
    return np.asarray(tilted - [*(low + high)[:2] / 2, low[2]])


def listing_of_homes(folder: Path) -> list[str]:
    """Return the lines of a listing: every scene of a folder, and the label and model of each of its pieces.

    Raises:
        UserError: if the folder holds no home, or a home is invalid.
    """
    homes = SweetHomes(str(folder), CategoryTable([Category("any", (0, 0, 0))]), 0.2)
    lines = []
    for split, paths in _split_files(folder).items():
        for scene in (name for path in paths for name in _scenes_of(path)):
            lines.append(f"{scene} ({split})")
            for piece, label, label_source, drawn_as in homes.piece_reports(scene):
                name = piece.name or piece.catalogue_id
                lines.append(f"    {name}: {label or 'no label'} (by {label_source}), drawn as {drawn_as}")
    return lines
