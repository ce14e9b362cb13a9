"""Rerun viewer: images, egocentric maps, the global map and the robot's path over time."""

from pathlib import Path
from typing import Any

import numpy as np

from imagination.geometry.pose import Pose
from imagination.mapping.semantic_mapper import SemanticMapper, Update
from imagination.mapping.visualization import FREE_COLOUR, OCCUPIED_COLOUR, UNKNOWN_COLOUR, draw_map
from imagination.utils.errors import check_range, require_extra

MAX_PLACES = 1000
"""Largest number of path points, which are all sent with every map; a longer path is thinned by half."""


class Rerun:
    """Viewer that logs to a new Rerun window or to an .rrd file.

    Args:
        file: name of the file in the results folder; None opens a live viewer.
        every: interval between two logs of the whole map, frames.

    Raises:
        UserError: if rerun-sdk is not installed, or a value is out of range.
    """

    def __init__(self, file: str | None = None, every: int = 5) -> None:
        self.file, self.every = file, int(check_range("viewer.every", every, 1, 100_000, "frames"))
        self._seen = 0
        self._path: list[Pose] = []
        require_extra("rerun", "rerun")
        import rerun

        self._rerun: Any = rerun

    def open(self, folder: Path, mapper: SemanticMapper) -> None:
        self._mapper = mapper
        self._stream = self._rerun.RecordingStream("imagination.map")
        if self.file is None:
            self._stream.spawn()
        else:
            self._stream.save(folder / self.file)

    def show(self, stamp: int, update: Update) -> None:
        rerun, log = self._rerun, self._stream.log
        self._stream.set_time("stamp", duration=np.timedelta64(stamp, "ns"))
        log("camera/rgb", rerun.Image(update.rgb))
        log("camera/depth", rerun.DepthImage(update.depth, meter=1.0))
        projection = np.full((*update.seen.shape, 3), UNKNOWN_COLOUR, np.uint8)
        projection[update.seen] = FREE_COLOUR
        projection[update.occupied] = OCCUPIED_COLOUR
        log("ego/projection", rerun.Image(projection))
        for category, layer in zip(self._mapper.spec.categories, update.probabilities, strict=True):
            log(f"ego/{category}", rerun.Image((255 * layer).astype(np.uint8)))
        self._path.append(update.pose)
        if len(self._path) > MAX_PLACES:
            self._path = [*self._path[:-1:2], update.pose]
        if self._seen % self.every == 0:
            self._show_map()
        self._seen += 1

    def close(self) -> None:
        if self._seen:
            self._show_map()
        self._stream.disconnect()

    def _show_map(self) -> None:
        """Log the picture of the map and the path in its pixel coordinates."""
        maps = self._mapper.maps
        self._stream.log("map", self._rerun.Image(draw_map(maps, self._mapper.spec.colours)))
        places = np.array([[pose.x, pose.y] for pose in self._path])
        pixels = (places - maps.grid.origin) / maps.grid.resolution
        pixels[:, 1] = maps.grid.rows - pixels[:, 1]
        self._stream.log("map/path", self._rerun.LineStrips2D([pixels]))
        self._stream.log("map/robot", self._rerun.Points2D(pixels[-1:], radii=3.0))
