"""Files of global maps: what an evaluation saves of every run, and what figures and recounts read.

A full evaluation writes maps/<scene>_<cell width>m_<viewpoint set>.npz, e.g. maps/test_0003_2.5m_0.npz: one file for
each run of the test scenes, cropped to the cells that hold anything at all, with

    name        type and shape    what
    scene        str               of the scene
    cell_width  float             metres between viewpoints
    number      int               of the viewpoint set
    approaches  str [a]           as in mapping.csv
    categories  str [c]           as in mapping.csv
    level       uint8 [a, c, h, w]  the global map, finished (closed, grown) as chosen, in hundredths reached: 0 to 99
    threshold   uint8 [a, c]      chosen on validation scenes, in hundredths
    truth       bool [c, h, w]    M_gt of the whole scene
    present     bool [c]          whether the scene contains the category; tables leave it out otherwise
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

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from imagination.evaluation.records import Example
from imagination.evaluation.threshold_selection import THRESHOLDS
from imagination.evaluation.trials import Trial
from imagination.geometry.grid import Grid
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import UserError, check_range

FOLDER = "maps"
"""Beside tables/ and figures/."""


FARTHEST = 10_000
"""Metres from a map's corner to a view of it, at most, and radians of a heading."""


class SavedMaps(NamedTuple):
    """The maps of one run; see the module's description."""

    trial: Trial
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
        return Example(self.trial, self.categories[layer], *shown)

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


def path_of(folder: Path, trial: Trial) -> Path:
    """File of a run's maps in an evaluation's folder."""
    return folder / FOLDER / f"{trial.scene}_{trial.cell_width:g}m_{trial.number}.npz"


def save(folder: Path, maps: SavedMaps) -> None:
    """Write the maps of a run into an evaluation's folder, whole or not at all; equal maps give equal bytes.

    Raises:
        UserError: if the disk is full or may not be written.
    """
    arrays = {name: getattr(maps, name) for name in SavedMaps._fields if name not in ("run", "grid")}
    with replacing(path_of(folder, maps.trial)) as temporary:
        np.savez_compressed(
            temporary,
            **maps.trial._asdict(),
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
        width = check_range("cell_width", float(arrays.pop("cell_width")), 0.0, 1e3, "m")
        trial = Trial(str(arrays.pop("scene")), width, int(arrays.pop("number")))
        x, y = arrays.pop("origin").tolist()
        rows, columns = arrays["seen"].shape
        grid = Grid(
            check_range("resolution", float(arrays.pop("resolution")), 0.005, 1.0), rows, columns, (x, y)
        )
        names = {name: arrays.pop(name).tolist() for name in ("approaches", "categories")}
        return _checked(SavedMaps(trial, **names, **arrays, grid=grid))
    except FileNotFoundError as error:
        raise UserError(f"maps: got {path}, but there is no such file") from error
    except Exception as error:  # zip, zlib and NumPy raise anything on a damaged file
        raise UserError(
            f"maps {path}: is damaged or no file of maps ({error}); evaluate again to make it"
        ) from error


def _checked(maps: SavedMaps) -> SavedMaps:
    """The same, if its arrays are as the module's description has them.

    Raises:
        UserError: with the first that is not.
    """
    for names in (maps.approaches, maps.categories):
        if not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
            raise UserError(f"approaches or categories: got {names}, expected each name once")
    over, shape = (len(maps.approaches), len(maps.categories)), maps.grid.shape
    expected = {
        "level": ("uint8", (*over, *shape)),
        "threshold": ("uint8", over),
        "truth": ("bool", (over[1], *shape)),
        "present": ("bool", over[1:]),
        "seen": ("bool", shape),
        "occupied": ("bool", shape),
        "poses": ("float64", (len(maps.poses), 3)),
    }
    for name, (kind, size) in expected.items():
        array = getattr(maps, name)
        if (array.dtype, array.shape) != (np.dtype(kind), size):
            raise UserError(f"{name}: got {array.dtype} of shape {array.shape}, expected {kind} of {size}")
    if maps.level.max(initial=0) > len(THRESHOLDS):
        raise UserError(f"level: got {maps.level.max()}, expected at most {len(THRESHOLDS)}")
    x, y = maps.grid.origin
    reach = maps.poses[:, :2] - (x, y)
    if not (np.abs([*reach.flat, *maps.poses[:, 2]]) <= FARTHEST).all():  # not a number is no less
        raise UserError(f"poses: got numbers beyond {FARTHEST}, or none, from the origin {x}, {y}")
    return maps
