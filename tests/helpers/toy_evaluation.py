"""Small evaluation without a network: hand-made rooms and a predictor that returns the ground truth."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imagination.evaluation.approaches import (
    Approach,
    ImaginableArea,
    Predictions,
    ProjectedSegmentation,
    SeenPrediction,
    Setting,
    ValidPrediction,
)
from imagination.evaluation.protocol import MappingProtocol, ModelUnderTest
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.geometry.projection import Band
from imagination.ground_truth.scene_maps import GroundTruthSpec
from imagination.mapping.update_rules import Max, MovingAverage
from imagination.scenes.categories import Category, CategoryTable
from imagination.scenes.sensor import IdealSensor
from imagination.utils.cache import Cache
from imagination.views.collector import Views
from imagination.views.observer import Observer
from imagination.views.scene_workers import ScenePool
from tests.helpers.room_source import Rooms

NAMES = ("chair", "bed", "table", "sofa")


@dataclass(frozen=True)
class Perfect:
    """Predictor of the ground-truth crop, and of the ground-truth segmentation without its right half."""

    layers: list[int]
    gives: frozenset[str] = frozenset({"maps", "images"})
    fingerprint: str = "perfect"

    def __call__(self, views: Views, wanted: Collection[str]) -> Predictions:
        images = views["categories"].copy()
        images[:, :, images.shape[2] // 2 :] = 0
        return {"maps": views["object"][:, self.layers].astype(np.float32), "images": images}


def make_model(
    folder: Path, categories: tuple[str, ...] = ("chair", "bed"), count: int = 2, workers: int = 0
) -> ModelUnderTest:
    """Return rooms at 0.1 m with a perfect predictor; no room contains a sofa."""
    camera = Camera(48, 48, np.pi / 2, 1.25)
    observer = Observer(
        Rooms(count),
        camera,
        IdealSensor(),
        EgoGrid.of_extent(3.7, 0.1),
        Band(0.2, 1.5),
        GroundTruthSpec(12.1, 0.1, 0.5, 0.6, Band(0.2, 1.5), camera),
        CategoryTable([Category(name, (255, 0, 0)) for name in NAMES]),
        Cache(folder),
    )
    layers = [NAMES.index(name) for name in categories]
    setting = Setting(camera, observer.ego, layers, list(categories), len(NAMES))
    return ModelUnderTest(ScenePool(observer, workers), setting, Perfect(layers))


def make_protocol(**changes: object) -> MappingProtocol:
    """Return a protocol of all approaches at two cell widths with two viewpoint sets each."""
    average = MovingAverage(0.9)
    approaches = {
        "seg_gt": Approach(ProjectedSegmentation(0.0, 2.6, np.inf), Max(), "close", (0.0, 0.3)),
        "seg_hrnet": Approach(ProjectedSegmentation(0.0, 2.6, np.inf, True), Max(), "close", (0.0, 0.3)),
        "imagination_seen": Approach(SeenPrediction(), average),
        "seen_dilated": Approach(SeenPrediction(), average, "dilate", (0.0, 0.3)),
        "imagination": Approach(ValidPrediction(0.5, 0.6), average),
        "oracle": Approach(ImaginableArea(1.0), Max(), "ground_truth"),
    }
    settings = {
        "cell_widths": [1.5, 1.0],
        "viewpoint_sets": 2,
        "orientations": 2,
        "seed": 0,
        "resamples": 100,
    }
    return MappingProtocol(approaches, **(settings | changes))  # type: ignore[arg-type]
