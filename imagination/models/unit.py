"""The interface of imagination units."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import log
from typing import NamedTuple

from jaxtyping import Float, Float16, UInt8
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d

from imagination.geometry.grid import EgoGrid
from imagination.geometry.morphology import kernel_cells
from imagination.utils.errors import check_range

PRIOR = 0.05
"""What an untrained unit answers about every cell: objects are rare, so training need not first learn that."""


class Prediction(NamedTuple):
    """Probabilities of V_object.

    Attributes:
        maps: as the unit answers.
        plain: before they were averaged and dilated; see `Unit`.
    """

    maps: Float[Tensor, "b c v v"]
    raw: Float[Tensor, "b c v v"]


class Unit(nn.Module, ABC):
    """What every unit is: one camera image and its depth in, logits of the egocentric maps of some categories out.

    A scene in a mirror is a scene too, so a unit may answer, outside training, with the mean of what it says of the view
    and of the view in a mirror; the paper's units look once. Nothing in the truth is thin, boxes that are filled, so
    its answers may be averaged and dilated over a window; the paper's units answer cell by cell.

    Args:
        categories: what to imagine, one map each; the paper has one unit for each category.
        tta_hflip: whether to look twice, outside training.
        postprocess_dilation: cells a side of the window outside training, an odd number; 1 for none.
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
        """Logits of V_object; their sigmoid is the imagined map.

        Args:
            rgb: camera image, 0 to 255.
            depth: of the same camera along its optical axis, metres; 0 where there is no return.
            occupied, seen: the depth's projection into the egocentric grid, 0 or 1.
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
        """What `forward` gives outside training, before it is averaged and dilated."""
        logits = self.logits(rgb, depth, occupied, seen)
        if self.tta_hflip:
            mirrored = self.logits(*(view.flip(-1) for view in (rgb, depth, occupied, seen)))
            logits = (logits + mirrored.flip(-1)) / 2
        return logits

    def postprocess(self, raw: Float[Tensor, "b c v v"]) -> Float[Tensor, "b c v v"]:
        """What `forward` makes of `plain`."""
        return smoothed_and_dilated(raw, self.postprocess_dilation)

    @abstractmethod
    def logits(
        self,
        rgb: UInt8[Tensor, "b 3 h w"],
        depth: Float16[Tensor, "b 1 h w"],
        occupied: UInt8[Tensor, "b 1 v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> Float[Tensor, "b c v v"]:
        """What `forward` gives of views as they are."""


def window_cells(size: float, ego: EgoGrid) -> int:
    """Cells a side of a window of `size` metres: an odd number, so that nothing shifts.

    >>> [window_cells(size, EgoGrid(resolution=0.06, cells=87)) for size in (0.0, 0.12, 0.18, 0.24)]
    [1, 3, 3, 5]
    """
    return (
        2
        * (kernel_cells(check_range("scale.postprocess_dilation", size, 0.0, 2.0, "m"), ego.resolution) // 2)
        + 1
    )


def smoothed_and_dilated(logits: Float[Tensor, "b c v v"], cells: int) -> Float[Tensor, "b c v v"]:
    """Logits averaged over a square of so many cells a side, then dilated by it: nothing thinner is drawn."""
    if cells == 1:
        return logits
    reach = cells // 2
    maps = logits.float().flatten(0, 1)[None]  # all maps as channels of one: torch pools these in parallel
    mean = avg_pool2d(maps, cells, stride=1, padding=reach, count_include_pad=False)
    return max_pool2d(mean, cells, stride=1, padding=reach).view_as(logits)


def prediction_head(width: int, categories: int) -> nn.Conv2d:
    """The last layer: logits of every category, about `PRIOR` to begin with."""
    head = nn.Conv2d(width, categories, 1)
    nn.init.constant_(head.bias, log(PRIOR / (1 - PRIOR)))  # type: ignore[arg-type]
    return head
