"""Files of global maps: an evaluation saves one per trial; figures and recounts read them.

A full evaluation writes maps/<scene>_<cell width>m_<viewpoint set>.npz, e.g. maps/test_0003_2.5m_0.npz: one file for
each trial of the test scenes, cropped to the cells that are not empty. Characters of a scene's name that cannot
be in a file name are replaced (see `file_name`). A file holds

    name        type and shape      content
    scene       str                 name of the scene
    cell_width  float               metres between viewpoints
    number      int                 index of the viewpoint set
    approaches  str [a]             names of the approaches, as in mapping.csv
    categories  str [c]             names of the categories, as in mapping.csv
    level       uint8 [a, c, h, w]  global map after postprocessing (closed, dilated): thresholds reached, 0 to 99
    threshold   uint8 [a, c]        threshold selected on validation scenes, in hundredths
    truth       bool [c, h, w]      ground-truth map M_gt of the whole scene
    present     bool [c]            whether the scene contains the category; tables leave it out otherwise
    seen        bool [h, w]         cells that at least one view saw
    occupied    bool [h, w]         occupancy map M_occu
    poses       float [n, 3]        x, y, heading of the views in the order of registration
    resolution  float               metres per cell
    origin      float [2]           world position of the lower-left corner of cell [h - 1, 0] (see conventions.md)

The predicted map is exactly `level >= threshold[..., None, None]`: candidate thresholds are whole hundredths, and
`level` counts those that the score reaches. `level / 100` is the score, rounded down. Read a file with `load`, or with
NumPy alone: `np.load(path, allow_pickle=False)`.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from imagination.evaluation.records import Example
from imagination.evaluation.threshold_selection import THRESHOLDS
from imagination.evaluation.trials import Trial
from imagination.geometry.grid import Grid
from imagination.utils.atomic_io import write_npz
from imagination.utils.errors import UserError, check_range
from imagination.utils.file_names import file_name

FOLDER = "maps"
"""Folder of the maps in the folder of the results."""


MAX_POSE = 10_000
"""Maximum distance from a map's corner to a view in metres, and maximum heading in radians."""


class SavedMaps(NamedTuple):
    """Maps of one trial; the module's docstring describes the fields."""

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
        """Predicted map of each approach and category."""
        return self.level >= self.threshold[..., None, None]

    def example(self, layer: int) -> Example:
        """Return the maps of one category, for figures."""
        predicted = {name: self.predicted[place, layer] for place, name in enumerate(self.approaches)}
        shown = self.grid, self.occupied, self.truth[layer], predicted, self.poses
        return Example(self.trial, self.categories[layer], *shown)

    def cropped(self) -> "SavedMaps":
        """Return the maps without empty rows and columns at the border, which changes no count of pixels."""
        filled = self.occupied | self.seen | self.truth.any(axis=0) | self.level.any(axis=(0, 1))
        cells = np.argwhere(filled)
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
    """Return the path of a trial's maps in the folder of the results."""
    return folder / FOLDER / f"{file_name(trial.scene)}_{trial.cell_width:g}m_{trial.number}.npz"


def save(folder: Path, maps: SavedMaps) -> None:
    """Write the maps of a trial into the folder of the results atomically; equal maps give equal bytes.

    Raises:
        UserError: if the disk is full or the folder cannot be written.
    """
    arrays = {name: getattr(maps, name) for name in SavedMaps._fields if name not in ("trial", "grid")}
    grid = {"resolution": maps.grid.resolution, "origin": maps.grid.origin}
    write_npz(path_of(folder, maps.trial), {**maps.trial._asdict(), **arrays, **grid})


def load(path: Path) -> SavedMaps:
    """Read the maps of a trial.

    Raises:
        UserError: if the file is missing or damaged, or does not hold maps.
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
        raise UserError(
            f"maps: got {path}, which does not exist; run the evaluation again to write it"
        ) from error
    except Exception as error:  # zip, zlib and NumPy raise various exceptions on damaged files
        raise UserError(
            f"maps {path}: is damaged or does not hold maps ({error}); run the evaluation again to write it"
        ) from error


def _checked(maps: SavedMaps) -> SavedMaps:
    """Check types and shapes of the arrays and return the maps.

    Raises:
        UserError: with the name of the first array that has a wrong type or shape.
    """
    for names in (maps.approaches, maps.categories):
        if not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
            raise UserError(f"approaches or categories: got {names}, expected each name once")
    leading, shape = (len(maps.approaches), len(maps.categories)), maps.grid.shape
    expected = {
        "level": ("uint8", (*leading, *shape)),
        "threshold": ("uint8", leading),
        "truth": ("bool", (leading[1], *shape)),
        "present": ("bool", leading[1:]),
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
    offsets = maps.poses[:, :2] - (x, y)
    if not (np.abs([*offsets.flat, *maps.poses[:, 2]]) <= MAX_POSE).all():  # also refuses NaN
        raise UserError(f"poses: got values that are not within {MAX_POSE} of the origin {x}, {y}")
    return maps
