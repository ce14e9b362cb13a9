"""Scores of egocentric maps: predictions of a unit, filtered as for mapping, against V_label."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d, pad
from torchmetrics import Metric

REGIONS = ("", "_seen", "_unseen")
"""Suffixes of the scores over all cells, cells seen in the depth image, and unseen cells."""

THRESHOLDS = tuple(round(0.05 * step, 2) for step in range(1, 20))
"""Candidates for the threshold of the egocentric map."""


class EgoScores(Metric):
    """Confusion counts of V_valid against V_label over all cells of all views, for every threshold in `THRESHOLDS`.

    Args:
        categories: number of categories.
        kernel: side of the kernel ε of M*_seen, cells.
        valid_threshold: τ_valid, the minimum prediction of the seen cells that M*_seen dilates.
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
        """Add the cells of a batch to the counts."""
        valid = neighbourhood(probabilities, seen, self.kernel, self.valid_threshold)
        gt, seen_mask = label > 0, seen > 0
        for counts, threshold in zip(self.counts, THRESHOLDS, strict=True):
            predicted = valid & (probabilities >= threshold)
            outcomes = torch.stack([predicted & gt, predicted & ~gt, ~predicted & gt])
            regions = [outcomes, outcomes & seen_mask, outcomes & ~seen_mask]
            counts += torch.stack([region.sum(dim=(1, 3, 4)) for region in regions])

    def compute(self) -> Int64[Tensor, "t r 3 c"]:
        """Return true positives, false positives and false negatives of each threshold, region and category."""
        return self.counts


def best_thresholds(counts: Int64[Tensor, "t r 3 c"]) -> Int64[Tensor, " c"]:
    """Return each category's index in `THRESHOLDS` of the highest IoU over all cells; the highest index on ties."""
    iou = torch.stack([ratios(at_threshold)["iou"] for at_threshold in counts[:, 0]])
    return len(iou) - 1 - iou.flip(0).argmax(dim=0)


def named_scores(
    counts: Int64[Tensor, "t r 3 c"], selected: Int64[Tensor, " c"], categories: Sequence[str]
) -> dict[str, Tensor]:
    """Return named scores at each category's threshold, e.g. `iou`, `iou_seen`, `iou_unseen`.

    The scores are means over the categories; with several categories, the scores of each, e.g. `iou_chair`, are
    included. A score whose denominator is 0, e.g. the precision without predicted cells, is 0.

    Args:
        counts: counts of `EgoScores`.
        selected: index in `THRESHOLDS` of each category's threshold.
        categories: names of the categories.
    """
    at_threshold = counts[selected, :, :, torch.arange(len(categories), device=counts.device)]
    scores = {}
    for region, region_counts in zip(REGIONS, at_threshold.permute(1, 2, 0), strict=True):
        for name, values in ratios(region_counts).items():
            scores[name + region] = values.mean()
            if len(categories) > 1:
                by_category = zip(categories, values, strict=True)
                scores |= {f"{name}{region}_{category}": value for category, value in by_category}
    return scores


def ratios(counts: Int64[Tensor, "3 c"]) -> dict[str, Float[Tensor, " c"]]:
    """Return IoU, precision and recall from counts of true positives, false positives and false negatives."""
    tp, fp, fn = counts
    return {
        "iou": tp / (tp + fp + fn).clamp(min=1),
        "precision": tp / (tp + fp).clamp(min=1),
        "recall": tp / (tp + fn).clamp(min=1),
    }


def neighbourhood(
    probabilities: Float[Tensor, "b c v v"],
    seen: UInt8[Tensor, "b 1 v v"],
    kernel: int,
    valid_threshold: float,
) -> Bool[Tensor, "b c v v"]:
    """Return M*_seen of a prediction: dilation([prediction ≥ τ_valid] ∘ V_seen, ε), with ε of `kernel` cells a side."""
    return dilate((probabilities >= valid_threshold) & (seen > 0), kernel)


def dilate(mask: Bool[Tensor, "b c h w"], kernel: int) -> Bool[Tensor, "b c h w"]:
    """Dilate a mask by a square of `kernel` cells a side: offsets -(k - 1)//2 to k//2, as with OpenCV's anchor.

    Padding is explicit, because max_pool2d pads both sides equally, which shifts even kernels and changes the size.
    """
    before, after = kernel // 2, (kernel - 1) // 2
    dilated = pad(mask.float(), (before, after, before, after))
    dilated = max_pool2d(max_pool2d(dilated, (1, kernel), stride=1), (kernel, 1), stride=1)
    return dilated > 0
