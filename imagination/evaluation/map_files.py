"""Files of global maps: what an evaluation saves of every run, and what figures and recounts read.

A full evaluation writes maps/<home>_<cell width>m_<viewpoint set>.npz, e.g. maps/test_0003_2.5m_0.npz: one file for
each run of the test homes, cropped to the cells that hold anything at all, with

    name        type and shape    what
    home        str               of the scene
    cell_width  float             metres between viewpoints
    number      int               of the viewpoint set
    approaches  str [a]           as in mapping.csv
    categories  str [c]           as in mapping.csv
    level       uint8 [a, c, h, w]  the global map, finished (closed, grown) as chosen, in hundredths reached: 0 to 99
    threshold   uint8 [a, c]      chosen on validation homes, in hundredths
    truth       bool [c, h, w]    M_gt of the whole home
    present     bool [c]          whether the home contains the category; tables leave it out otherwise
    seen        bool [h, w]       cells that a view saw
    occupied    bool [h, w]       M_occu
    poses       float [n, 3]      x, y, heading of the views in the order of registration
    resolution  float             metres a cell
    origin      float [2]         world position of the lower-left corner of cell [h - 1, 0] (docs/conventions.md)

The predicted map is `level >= threshold[..., None, None]`, exactly: candidates for thresholds are whole hundredths, and
`level` counts those that the score reaches. `level / 100` is the score, rounded down. Read a file with `load`, or with
numpy alone: `np.load(path, allow_pickle=False)`.
"""

from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from imagination.errors import UserError
from imagination.evaluation.outcome import Example
from imagination.evaluation.runs import Run
from imagination.geometry.grid import Grid
from imagination.runs import replacing

FOLDER = "maps"
"""Beside tables/ and figures/."""


class SavedMaps(NamedTuple):
    """The maps of one run; see the module's description."""

    run: Run
    approaches: list[str]
    categories: list[str]
    level: UInt8[np.ndarray, "a c h w"]
    threshold: UInt8[np.ndarray, "a c"]
    truth: Bool[np.ndarray, "c h w"]
    present: Bool[np.ndarray, " c"]
    seen: Bool[np.ndarray, "h w"]
    occupied: Bool[np.ndarray, "h w"]
    poses: Float64[np.ndarray, "n 3"]
    grid: Grid

    @property
    def predicted(self) -> Bool[np.ndarray, "a c h w"]:
        """The map of each approach and category."""
        return self.level >= self.threshold[..., None, None]

    def example(self, layer: int) -> Example:
        """The maps of one category, for figures."""
        predicted = {name: self.predicted[place, layer] for place, name in enumerate(self.approaches)}
        shown = self.grid, self.occupied, self.truth[layer], predicted, self.poses
        return Example(self.run, self.categories[layer], *shown)

    def cropped(self) -> "SavedMaps":
        """The same without rows and columns at the rim that hold nothing; no count of pixels changes."""
        held = self.occupied | self.seen | self.truth.any(axis=0) | self.level.any(axis=(0, 1))
        cells = np.argwhere(held)
        if not len(cells):
            return self
        (top, left), (bottom, right) = cells.min(axis=0).tolist(), (cells.max(axis=0) + 1).tolist()
        size, (x, y) = self.grid.resolution, self.grid.origin
        origin = x + left * size, y + (self.grid.rows - bottom) * size
        window = np.s_[..., top:bottom, left:right]
        return self._replace(
            level=self.level[window],
            truth=self.truth[window],
            seen=self.seen[window],
            occupied=self.occupied[window],
            grid=Grid(size, bottom - top, right - left, origin),
        )


def path_of(folder: Path, run: Run) -> Path:
    """File of a run's maps in an evaluation's folder."""
    return folder / FOLDER / f"{run.home}_{run.cell_width:g}m_{run.number}.npz"


def save(folder: Path, maps: SavedMaps) -> None:
    """Write the maps of a run into an evaluation's folder, whole or not at all; equal maps give equal bytes.

    Raises:
        UserError: if the disk is full or may not be written.
    """
    arrays = {name: getattr(maps, name) for name in SavedMaps._fields if name not in ("run", "grid")}
    with replacing(path_of(folder, maps.run)) as temporary:
        np.savez_compressed(
            temporary,
            **maps.run._asdict(),
            **arrays,
            resolution=maps.grid.resolution,
            origin=maps.grid.origin,
        )


def load(path: Path) -> SavedMaps:
    """Read the maps of a run.

    Raises:
        UserError: if there is no such file, or it is not one of maps.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        run = Run(str(arrays.pop("home")), float(arrays.pop("cell_width")), int(arrays.pop("number")))
        x, y = arrays.pop("origin").tolist()
        rows, columns = arrays["seen"].shape
        grid = Grid(float(arrays.pop("resolution")), rows, columns, (x, y))
        names = {name: arrays.pop(name).tolist() for name in ("approaches", "categories")}
        return SavedMaps(run, **names, **arrays, grid=grid)
    except FileNotFoundError as error:
        raise UserError(f"maps: got {path}, but there is no such file") from error
    except (BadZipFile, EOFError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"maps {path}: is damaged or no file of maps; evaluate again to make it") from error
