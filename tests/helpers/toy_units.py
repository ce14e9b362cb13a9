"""Stand-ins for trained units, whose predictions depend on every input and its position; and test viewers."""

from pathlib import Path

import cv2
import numpy as np

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.geometry.projection import Band
from imagination.mapping.predictor import Observation, UnitSpec
from imagination.mapping.semantic_mapper import SemanticMapper, Update
from imagination.viewers.viewer import NoViewer

CAMERA = Camera.from_degrees(48, 48, 90.0, 1.25)
EGO = EgoGrid(0.12, 31)


class Toy:
    """Predictor of blurred occupancy, weighted by the image columns; one map per category."""

    def __init__(self, *categories: str, camera: Camera = CAMERA, ego: EgoGrid = EGO) -> None:
        names = categories or ("chair",)
        colours = tuple((200, 60 * number, 40) for number in range(len(names)))
        thresholds = (0.5,) * len(names)
        self.spec = UnitSpec(names, colours, thresholds, camera, ego, Band(0.2, 1.5), 0.5, 0.62)

    def __call__(self, observation: Observation) -> np.ndarray:
        cells = self.spec.ego.cells
        blurred = cv2.blur(observation.occupied.astype(np.float32), (3, 5)) * 2
        shade = cv2.resize(observation.rgb[..., 0].mean(axis=0)[None] / 255, (cells, 1))
        base = np.clip(blurred * (0.5 + shade) + 0.1 * observation.seen, 0, 1).astype(np.float32)
        return np.stack([base ** (number + 1) for number in range(len(self.spec.categories))])


class Marker(NoViewer):
    """Viewer that writes a file when a frame is shown."""

    def open(self, folder: Path, mapper: SemanticMapper) -> None:
        self.file = folder / "shown"

    def show(self, stamp: int, update: Update) -> None:
        self.file.touch()


class Blocking(NoViewer):
    """Viewer that blocks the map's file name, and writes a file when it is closed."""

    def open(self, folder: Path, mapper: SemanticMapper) -> None:
        self.folder = folder
        (folder / "map.yaml").mkdir()

    def close(self) -> None:
        (self.folder / "closed").touch()


class Failing(NoViewer):
    """Viewer that raises at the third frame."""

    shown = 0

    def show(self, stamp: int, update: Update) -> None:
        self.shown += 1
        if self.shown == 3:
            raise RuntimeError("the viewer is broken")
