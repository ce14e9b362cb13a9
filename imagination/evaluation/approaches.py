"""Mapping approaches under comparison: evidence of a view, its fusion into a map, and postprocessing of the map."""

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
"""Network predictions for views by the names in `NEEDS`."""

NEEDS = {
    "maps": "a unit's checkpoint",
    "raw_maps": "a unit's checkpoint",
    "maps_of_shuffled_rgb": "a unit's checkpoint",
    "images": "a checkpoint of a segmentation network, or the folder of public weights (ade20k=FOLDER)",
}
"""Network predictions that an approach may need, and the checkpoint that provides each.

- maps, float32 [n, c, v, v]: probabilities of the evaluated categories.
- raw_maps: probabilities before test-time averaging and dilation.
- maps_of_shuffled_rgb: probabilities for views whose colour images are swapped among the views.
- images, uint8 [n, h, w]: first-person segmentations, 0 for no category, else the category's row + 1.
"""


REFERENCE = "imagination"
"""Name of the approach that the paired differences compare with the others."""

CONTROLS = ("seg_gt", "oracle", "rgb_shuffled")
"""Approaches that see the ground truth, and controls: never the best of a table, as in the paper."""


class Setting(NamedTuple):
    """Camera, grid and categories common to all approaches.

    Attributes:
        camera: camera of the views.
        ego: egocentric grid of the views.
        layers: rows of the category table that are evaluated.
        categories: names of the evaluated categories.
        table_size: number of rows of the category table.
    """

    camera: Camera
    ego: EgoGrid
    layers: list[int]
    categories: list[str]
    table_size: int


@runtime_checkable
class EvidenceSource(Protocol):
    """Converter of views into `ViewEvidence`; hashable, so that approaches with equal source and rule share a map."""

    @property
    def needs(self) -> str | None:
        """Network prediction that it needs, one of `NEEDS`; None if it needs no network."""

    def __call__(self, views: Views, predictions: Predictions, setting: Setting) -> ViewEvidence:
        """Return the evidence of `views`, given the network predictions for each view."""


@dataclass(frozen=True)
class ProjectedSegmentation:
    """First-person segmentation projected by depth: ordinary semantic mapping.

    The observed cells of a view are those that it saw and those that contain a depth return of the category.

    Attributes:
        low: lower limit of the height band of depth returns, metres above the floor.
        high: upper limit of the height band of depth returns, metres above the floor.
        max_range: maximum depth of returns, metres.
        predicted: whether a network predicts the segmentation; otherwise it is the ground truth.
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
        projected = np.zeros((len(images), len(setting.layers), size, size), bool)
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
            projected[index] = layers[setting.layers]
        return ViewEvidence(projected.astype(np.float32), projected | views["seen"][:, None])


@dataclass(frozen=True)
class SeenPrediction:
    """Approach imagination_seen: the prediction in the cells that depth saw, prediction ∘ V_seen.

    Attributes:
        needs: "maps", or "raw_maps" if the approach dilates the map itself, so that no map is dilated twice.
    """

    needs: str = "maps"

    def __post_init__(self) -> None:
        check_choice("evidence.needs", self.needs, ("maps", "raw_maps"))

    def __call__(self, views: Views, predictions: Predictions, setting: Setting) -> ViewEvidence:
        probabilities = predictions[self.needs]
        # masked, not set to zero: registration would interpolate zeros into the boundary of V_seen
        return ViewEvidence(probabilities, np.broadcast_to(views["seen"][:, None], probabilities.shape))


@dataclass(frozen=True)
class ValidPrediction:
    """Approach imagination: V_valid = prediction ∘ M*_seen; see `valid_imagination`.

    Attributes:
        threshold: threshold tau_valid.
        kernel: dilation kernel epsilon, metres.
        needs: "maps", or "maps_of_shuffled_rgb" to test whether the network uses colour.
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
    """Imaginable area V_filter = dilation(V_object ∘ V_seen, delta), computed from the ground truth.

    With postprocess `ground_truth` it is the oracle: a unit that predicts the label V_label of each view, without any
    loss when views are registered.

    Attributes:
        kernel: dilation kernel delta, metres.
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
    """Mapping approach, one row of the tables.

    Attributes:
        evidence: source of the evidence of a view.
        rule: update rule that fuses the evidence of successive views.
        postprocess: operation on the map after its threshold: none, close (fill gaps), dilate, or ground_truth (remove
            cells outside the ground truth, for upper bounds).
        kernels: candidate kernels of closing or dilation, metres; the best on validation scenes is selected.
    """

    evidence: EvidenceSource
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
        """Key of the map before postprocessing; approaches with equal keys share one map."""
        return self.evidence, self.rule

    def apply_postprocess(
        self,
        score: Float32[np.ndarray, "h w"],
        gt: Bool[np.ndarray, "h w"],
        kernel: float,
        resolution: float,
    ) -> Float32[np.ndarray, "h w"]:
        """Postprocess the score map; its threshold then equals postprocessing of the thresholded map.

        The order does not matter, since dilation and erosion with a flat kernel take the largest and smallest score.
        """
        if self.postprocess == "ground_truth":
            return np.where(gt, score, np.float32(0))
        cells = kernel_cells(kernel, resolution) if kernel > 0 else 1
        if self.postprocess == "none" or cells == 1:
            return score
        return (close if self.postprocess == "close" else dilate)(score, cells)
