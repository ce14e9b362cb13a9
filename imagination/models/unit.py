"""Interface of imagination units."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import log
from typing import NamedTuple

from jaxtyping import Float, Float16, UInt8
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d

from imagination.geometry.grid import EgoGrid
from imagination.geometry.morphology import kernel_cells
from imagination.models.tta_hflip import average_with_hflip
from imagination.utils.errors import check_range

PRIOR = 0.05
"""Initial foreground probability of every cell (bias of the output layer): objects are rare."""


class Prediction(NamedTuple):
    """Probabilities of V_object.

    Attributes:
        maps: probabilities of the postprocessed logits.
        raw: probabilities of the raw logits; see `Unit`.
    """

    maps: Float[Tensor, "b c v v"]
    raw: Float[Tensor, "b c v v"]


class Unit(nn.Module, ABC):
    """Base class of units, which predict logits of egocentric maps from a camera image and its depth.

    Two optional steps in evaluation mode, which the paper's units lack:

    - Horizontal-flip test-time augmentation averages the logits of a view and of its mirror image, since a mirrored
      scene is a plausible scene. The result is the raw logits.
    - Postprocessing averages and dilates the raw logits over a window, since the ground truth consists of filled boxes
      and has no thin parts. The result is the postprocessed logits.

    Args:
        categories: names of the categories, one map each; the paper has one unit per category.
        tta_hflip: whether to use horizontal-flip test-time augmentation in evaluation mode.
        postprocess_dilation: side of the window in evaluation mode, an odd number of cells; 1 disables it.
    """

    def __init__(
        self, categories: Sequence[str], tta_hflip: bool = False, postprocess_dilation: int = 1
    ) -> None:
        super().__init__()
        self.categories = list(categories)
        self.tta_hflip = tta_hflip
        self.postprocess_dilation = postprocess_dilation

    def forward(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """Return the logits of V_object, whose sigmoid is the imagined map; postprocessed in evaluation mode.

        Args:
            rgb: camera image, 0 to 255.
            depth: depth along the optical axis of the same camera, metres; 0 without a return.
            occupied, seen: projection of the depth into the egocentric grid, 0 or 1.
        """
        if self.training:
            return self.logits(rgb, depth, occupied, seen)
        return self.postprocess(self.raw(rgb, depth, occupied, seen))

    def raw(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """Return the raw logits, with test-time augmentation but without postprocessing."""
        if self.tta_hflip:
            return average_with_hflip(self.logits, rgb, depth, occupied, seen)
        return self.logits(rgb, depth, occupied, seen)

    def postprocess(self, raw: Float[Tensor, "b c v v"]) -> Float[Tensor, "b c v v"]:
        """Return the postprocessed logits, averaged and dilated over the window."""
        return smoothed_and_dilated(raw, self.postprocess_dilation)

    @abstractmethod
    def logits(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """Return the logits of views, without test-time augmentation or postprocessing."""


def window_cells(size: float, ego: EgoGrid) -> int:
    """Return the side of a window of `size` metres in cells: an odd number, so that nothing shifts.

    >>> [window_cells(size, EgoGrid(resolution=0.06, cells=87)) for size in (0.0, 0.12, 0.18, 0.24)]
    [1, 3, 3, 5]
    """
    check_range("model.postprocess_dilation", size, 0.0, 2.0, "m")
    return 2 * (kernel_cells(size, ego.resolution) // 2) + 1


def smoothed_and_dilated(logits: Float[Tensor, "b c v v"], cells: int) -> Float[Tensor, "b c v v"]:
    """Average logits over a square window of `cells` cells a side, then dilate them by it."""
    if cells == 1:
        return logits
    reach = cells // 2
    maps = logits.float().flatten(0, 1)[None]  # as channels of one map, which torch pools in parallel
    mean = avg_pool2d(maps, cells, stride=1, padding=reach, count_include_pad=False)
    return max_pool2d(mean, cells, stride=1, padding=reach).view_as(logits)


def prediction_head(width: int, categories: int) -> nn.Conv2d:
    """Return the output layer, which predicts about `PRIOR` for every category before training."""
    head = nn.Conv2d(width, categories, 1)
    nn.init.constant_(head.bias, log(PRIOR / (1 - PRIOR)))  # type: ignore[arg-type]
    return head
