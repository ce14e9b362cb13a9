"""The approaches compared: evidence of a view, its fusion and postprocessing of the map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.geometry.morphology import close, dilate, kernel_cells
from imagination.geometry.projection import Band, project_categories
from imagination.ground_truth.targets import imaginable_mask
from imagination.mapping.predictor import ViewEvidence, valid_imagination
from imagination.mapping.update_rules import UpdateRule
from imagination.utils.errors import check_choice, check_range
from imagination.views.collector import Views

Predictions = dict[str, np.ndarray]
"""What networks say about views, by the name of a need: see `NEEDS`."""

NEEDS = {
    "maps": "a unit's checkpoint",
    "raw_maps": "a unit's checkpoint",
    "maps_of_shuffled_rgb": "a unit's checkpoint",
    "images": "a checkpoint of a segmentation network, or the folder of public weights (ade20k=FOLDER)",
}
"""What an approach may need of networks, and where it comes from: maps, float32 [n, c, v, v], are the probabilities of
the evaluated categories; raw_maps are the same before units averaged and dilated them, maps_of_shuffled_rgb those of
views each of which had the colours of another one; images, uint8 [n, h, w], are first-person segmentations, 0 for none,
else the category's row + 1."""


REFERENCE = "imagination"
"""The approach that the others are compared with in pairs."""

NO_RIVALS = ("seg_gt", "oracle", "rgb_shuffled")
"""Approaches that are told the truth about a view, and controls: never the best of a table, as in the paper."""


class Setting(NamedTuple):
    """What all approaches share.

    Attributes:
        camera, ego: of the views.
        layers: rows of the category table that are evaluated.
        categories: their names.
        table_size: rows of the category table.
    """

    camera: Camera
    ego: EgoGrid
    layers: list[int]
    categories: list[str]
    table_size: int


@runtime_checkable
class Evidence(Protocol):
    """Turns views into statements. Hashable, so that approaches with equal evidence and rule share a map."""

    @property
    def needs(self) -> str | None:
        """What it needs of networks, one of `NEEDS`; None if nothing."""

    def __call__(self, views: Views, predictions: Predictions, setting: Setting) -> ViewEvidence:
        """What `views` say, given the networks' predictions for each."""


@dataclass(frozen=True)
class ProjectedSegmentation:
    """First-person segmentation, projected by depth: ordinary semantic mapping.

    A view has something to say about the cells it saw and those that a return of the category fell into.

    Attributes:
        low, high: band of heights above the floor whose returns count, metres.
        max_range: depth beyond which returns are ignored, metres.
        predicted: whether the segmentation is a network's; else it is the ground truth, a perfect network's.
    """

    low: float
    high: float
    max_range: float
    predicted: bool = False

    def __post_init__(self) -> None:
        check_range("seg.high", self.high, self.low, 100.0, "m", open_low=True)
        check_range("seg.max_range", self.max_range, 0.0, np.inf, "m", open_low=True)

    @property
    def needs(self) -> str | None:
        return "images" if self.predicted else None

    def __call__(self, views: Views, predictions: Predictions, setting: Setting) -> ViewEvidence:
        images = predictions["images"] if self.predicted else views["categories"]
        size = setting.ego.cells
        found = np.zeros((len(images), len(setting.layers), size, size), bool)
        for index, (depth, image) in enumerate(zip(views["depth"], images, strict=True)):
            layers = project_categories(
                depth.astype(np.float32),
                image,
                setting.camera,
                setting.ego,
                setting.table_size,
                Band(self.low, self.high),
                self.max_range,
            )
            found[index] = layers[setting.layers]
        return ViewEvidence(found.astype(np.float32), found | views["seen"][:, None])


@dataclass(frozen=True)
class SeenPrediction:
    """imagination_seen: the prediction where depth saw the cell, prediction ∘ V_seen.

    Attributes:
        needs: maps, or raw_maps for what is to be grown by itself: grown twice is worse than once.
    """

    needs: str = "maps"

    def __post_init__(self) -> None:
        check_choice("evidence.needs", self.needs, ("maps", "raw_maps"))

    def __call__(self, views: Views, predictions: Predictions, setting: Setting) -> ViewEvidence:
        probabilities = predictions[self.needs]
        # masked by what is written, not by zeros: these would be mixed into the rim of V_seen when views are registered
        return ViewEvidence(probabilities, np.broadcast_to(views["seen"][:, None], probabilities.shape))


@dataclass(frozen=True)
class ValidPrediction:
    """imagination: V_valid = prediction ∘ M*_seen; see `valid_imagination`.

    Attributes:
        threshold: tau_valid.
        kernel: epsilon, metres.
        needs: maps, or maps_of_shuffled_rgb to learn whether the network looks at colour at all.
    """

    threshold: float
    kernel: float
    needs: str = "maps"

    def __post_init__(self) -> None:
        check_range("mapping.valid_threshold", self.threshold, 0.0, 1.0, open_low=True)
        check_range("mapping.valid_kernel", self.kernel, 0.0, 100.0, "m")
        check_choice("evidence.needs", self.needs, ("maps", "maps_of_shuffled_rgb"))

    def __call__(self, views: Views, predictions: Predictions, setting: Setting) -> ViewEvidence:
        seen, resolution = views["seen"][:, None], setting.ego.resolution
        return valid_imagination(predictions[self.needs], seen, self.threshold, self.kernel, resolution)


@dataclass(frozen=True)
class ImaginableArea:
    """Where anything can be imagined, V_filter = dilation(V_object ∘ V_seen, delta), made from the truth.

    With postprocess `ground_truth` it becomes the oracle: a unit that answers each view with its label, V_label, and loses
    nothing when views are registered.

    Attributes:
        kernel: delta, metres.
    """

    kernel: float
    needs: ClassVar[None] = None

    def __post_init__(self) -> None:
        check_range("kernels.imaginable", self.kernel, 0.0, 100.0, "m")

    def __call__(self, views: Views, predictions: Predictions, setting: Setting) -> ViewEvidence:
        delta = kernel_cells(self.kernel, setting.ego.resolution)
        mask = imaginable_mask(views["object"][:, setting.layers], views["seen"][:, None], delta)
        return ViewEvidence(mask.astype(np.float32), mask)


@dataclass(frozen=True)
class Approach:
    """One row of the tables.

    Attributes:
        evidence: what it says about a view.
        rule: how the statements of successive views are put together.
        postprocess: applied to the map after its threshold: none, close (fill gaps), dilate, or ground_truth (remove
            cells that are not in the ground truth: for upper bounds).
        kernels: candidates for closing or growing, metres; the best on validation scenes is taken.
    """

    evidence: Evidence
    rule: UpdateRule
    postprocess: str = "none"
    kernels: Sequence[float] = (0.0,)

    def __post_init__(self) -> None:
        check_choice("approach.postprocess", self.postprocess, ("none", "close", "dilate", "ground_truth"))
        for kernel in self.kernels:
            check_range("approach.kernels", kernel, 0.0, 10.0, "m")
        check_range("approach.kernels", len(self.kernels), 1, 1000, "candidates")

    @property
    def map_key(self) -> tuple[Any, ...]:
        """Approaches with equal keys have the same map before finishing."""
        return self.evidence, self.rule

    def apply_postprocess(
        self,
        score: Float32[np.ndarray, "h w"],
        truth: Bool[np.ndarray, "h w"],
        kernel: float,
        resolution: float,
    ) -> Float32[np.ndarray, "h w"]:
        """The score whose thresholding equals thresholding first and finishing then.

        That order does not matter, since a dilation or erosion with a flat kernel takes the largest or smallest score.
        """
        if self.postprocess == "ground_truth":
            return np.where(truth, score, np.float32(0))
        cells = kernel_cells(kernel, resolution) if kernel > 0 else 1
        if self.postprocess == "none" or cells == 1:
            return score
        return (close if self.postprocess == "close" else dilate)(score, cells)
