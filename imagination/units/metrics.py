"""Scores of egocentric maps: what a unit imagines, filtered as for mapping, against V_label."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d, pad
from torchmetrics import Metric

REGIONS = ("", "_seen", "_unseen")
"""Suffixes of the scores: over all cells, over those the depth image saw, over the others."""


class EgoScores(Metric):
    """IoU, precision and recall of V_valid, thresholded, against V_label, pooled over all cells of all views.

    A score whose denominator is 0 (nothing predicted, say) is 0.

    Args:
        categories: names of the maps.
        kernel: of M*_seen, ε, cells.
        threshold: from which value on a cell of V_valid counts as occupied.
        valid_threshold: τ_valid, from which value on a seen cell of the prediction is an object that M*_seen surrounds.
    """

    full_state_update = False
    counts: Tensor

    def __init__(
        self, categories: Sequence[str], kernel: int, threshold: float = 0.5, valid_threshold: float = 0.5
    ) -> None:
        super().__init__()
        self.categories = list(categories)
        self.kernel = kernel
        self.threshold = threshold
        self.valid_threshold = valid_threshold
        empty = torch.zeros(len(REGIONS), 3, len(self.categories), dtype=torch.long)
        self.add_state("counts", empty, dist_reduce_fx="sum")

    def update(
        self,
        probabilities: Float[Tensor, "b c v v"],
        label: UInt8[Tensor, "b c v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> None:
        """Count the cells of a batch."""
        valid = neighbourhood(probabilities, seen, self.kernel, self.valid_threshold)
        predicted, truth, saw = valid & (probabilities >= self.threshold), label > 0, seen > 0
        outcomes = torch.stack([predicted & truth, predicted & ~truth, ~predicted & truth])
        regions = [outcomes, outcomes & saw, outcomes & ~saw]
        self.counts += torch.stack([region.sum(dim=(1, 3, 4)) for region in regions])

    def compute(self) -> dict[str, Tensor]:
        """Scores, e.g. `iou`, `iou_seen`, `iou_unseen`: means over the categories; with several, those of each too."""
        scores = {}
        for region, counts in zip(REGIONS, self.counts, strict=True):
            for name, values in ratios(counts).items():
                scores[name + region] = values.mean()
                if len(self.categories) > 1:
                    each = zip(self.categories, values, strict=True)
                    scores |= {f"{name}{region}_{category}": value for category, value in each}
        return scores


def ratios(counts: Int64[Tensor, "3 c"]) -> dict[str, Float[Tensor, " c"]]:
    """IoU, precision and recall from the numbers of true positive, false positive and false negative cells."""
    hits, false_alarms, misses = counts
    return {
        "iou": hits / (hits + false_alarms + misses).clamp(min=1),
        "precision": hits / (hits + false_alarms).clamp(min=1),
        "recall": hits / (hits + misses).clamp(min=1),
    }


def neighbourhood(
    probabilities: Float[Tensor, "b c v v"],
    seen: UInt8[Tensor, "b 1 v v"],
    kernel: int,
    valid_threshold: float,
) -> Bool[Tensor, "b c v v"]:
    """M*_seen after prediction: dilation([prediction ≥ τ_valid] ∘ V_seen, ε), `kernel` cells a side."""
    return dilate((probabilities >= valid_threshold) & (seen > 0), kernel)


def dilate(mask: Bool[Tensor, "b c h w"], kernel: int) -> Bool[Tensor, "b c h w"]:
    """Grow a mask by a square of `kernel` cells a side: offsets -(k - 1)//2 to k//2, OpenCV's anchor.

    max_pool2d pads both sides alike, which shifts even kernels and changes the size; so padding is explicit.
    """
    before, after = kernel // 2, (kernel - 1) // 2
    grown = pad(mask.float(), (before, after, before, after))
    grown = max_pool2d(max_pool2d(grown, (1, kernel), stride=1), (kernel, 1), stride=1)
    return grown > 0
