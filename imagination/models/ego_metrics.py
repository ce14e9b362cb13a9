"""Scores of egocentric maps: what a unit imagines, filtered as for mapping, against V_label."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d, pad
from torchmetrics import Metric

REGIONS = ("", "_seen", "_unseen")
"""Suffixes of the scores: over all cells, over those the depth image saw, over the others."""


THRESHOLDS = tuple(round(0.05 * step, 2) for step in range(1, 20))
"""Candidates for the threshold of the egocentric map."""


class EgoScores(Metric):
    """Counts of V_valid against V_label, over all cells of all views, for every threshold in `THRESHOLDS`.

    Args:
        categories: how many maps.
        kernel: of M*_seen, ε, cells.
        valid_threshold: τ_valid, from which value on a seen cell of the prediction is an object that M*_seen surrounds.
    """

    full_state_update = False
    counts: Tensor

    def __init__(self, categories: int, kernel: int, valid_threshold: float = 0.5) -> None:
        super().__init__()
        self.kernel = kernel
        self.valid_threshold = valid_threshold
        empty = torch.zeros(len(THRESHOLDS), len(REGIONS), 3, categories, dtype=torch.long)
        self.add_state("counts", empty, dist_reduce_fx="sum")

    def update(
        self,
        probabilities: Float[Tensor, "b c v v"],
        label: UInt8[Tensor, "b c v v"],
        seen: UInt8[Tensor, "b 1 v v"],
    ) -> None:
        """Count the cells of a batch."""
        valid = neighbourhood(probabilities, seen, self.kernel, self.valid_threshold)
        truth, saw = label > 0, seen > 0
        for counts, threshold in zip(self.counts, THRESHOLDS, strict=True):
            predicted = valid & (probabilities >= threshold)
            outcomes = torch.stack([predicted & truth, predicted & ~truth, ~predicted & truth])
            regions = [outcomes, outcomes & saw, outcomes & ~saw]
            counts += torch.stack([region.sum(dim=(1, 3, 4)) for region in regions])

    def compute(self) -> Int64[Tensor, "t r 3 c"]:
        """Hits, false alarms and misses, for each threshold, region and category."""
        return self.counts


def best_thresholds(counts: Int64[Tensor, "t r 3 c"]) -> Int64[Tensor, " c"]:
    """Which of `THRESHOLDS` gives each category the highest IoU over all cells; the highest of equals."""
    iou = torch.stack([ratios(each)["iou"] for each in counts[:, 0]])
    return len(iou) - 1 - iou.flip(0).argmax(dim=0)


def named_scores(
    counts: Int64[Tensor, "t r 3 c"], chosen: Int64[Tensor, " c"], categories: Sequence[str]
) -> dict[str, Tensor]:
    """Scores at each category's threshold, e.g. `iou`, `iou_seen`, `iou_unseen`.

    They are means over the categories; with several, those of each stand beside them. A score whose denominator is 0
    (nothing predicted, say) is 0.
    """
    at_threshold = counts[chosen, :, :, torch.arange(len(categories), device=counts.device)]
    scores = {}
    for region, of_region in zip(REGIONS, at_threshold.permute(1, 2, 0), strict=True):
        for name, values in ratios(of_region).items():
            scores[name + region] = values.mean()
            if len(categories) > 1:
                each = zip(categories, values, strict=True)
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
