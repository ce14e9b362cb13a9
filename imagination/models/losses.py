"""Losses on logits: weighted binary cross-entropy of the paper (section IV-B) and cross-entropy with batch dice."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from imagination.utils.errors import check_range
from imagination.utils.process_group import sum_over_ranks, world_size


class Result(NamedTuple):
    """Result of a loss.

    Attributes:
        loss: loss of the batch; its gradients, averaged over ranks, are those of the whole batch.
        parts: components of the loss and other values to log, by name.
    """

    loss: Float[Tensor, ""]
    parts: dict[str, Tensor]


@runtime_checkable
class Loss(Protocol):
    """Loss between imagined maps and labels, summed over categories.

    Attributes:
        in_parts: whether the loss can be computed on micro-batches: given the counts of the whole batch, the losses of
            its parts add up to the loss of the batch.
    """

    in_parts: ClassVar[bool]

    def __call__(
        self,
        logits: Float[Tensor, "b c v v"],
        label: UInt8[Tensor, "b c v v"],
        neighbourhood: UInt8[Tensor, "b c v v"],
        counts: Int64[Tensor, "3 c"] | None = None,
    ) -> Result:
        """Return the loss of a batch or, with `counts`, of a part of a batch; see `imagination_loss`."""


@dataclass(frozen=True)
class WeightedBCE:
    """Weighted binary cross-entropy of the paper; see `imagination_loss`.

    Attributes:
        alpha_max, gamma_max: upper bounds of the weights.

    Raises:
        UserError: if a bound is out of range.
    """

    in_parts = True
    alpha_max: float = 30.0
    gamma_max: float = 10.0

    def __post_init__(self) -> None:
        check_range("model.loss.alpha_max", self.alpha_max, 1, 10_000)
        check_range("model.loss.gamma_max", self.gamma_max, 1, 10_000)

    def __call__(
        self,
        logits: Float[Tensor, "b c v v"],
        label: UInt8[Tensor, "b c v v"],
        neighbourhood: UInt8[Tensor, "b c v v"],
        counts: Int64[Tensor, "3 c"] | None = None,
    ) -> Result:
        loss, weights = imagination_loss(logits, label, neighbourhood, self.alpha_max, self.gamma_max, counts)
        return Result(loss, {"w_alpha": weights.alpha.mean(), "w_gamma": weights.gamma.mean()})


@dataclass(frozen=True)
class BCEDice:
    """Binary cross-entropy averaged over all cells, plus the dice loss of the whole batch; not in the paper.

    With p = σ(logits) and y = V_label, separately for each category, and sums over all cells of all views:

        dice = 1 - 2 (Σ p y + 1) / (Σ p + Σ y + 2)

    (Milletari et al. 2016, V-Net, without the squares in the denominator.) The sums run over the whole batch, because
    a single view often has no label cell. The constants +1 and +2 give a batch without label cells a gradient.

    The gradient of one view depends on the predictions of all other views, so the loss cannot be computed on
    micro-batches.
    """

    in_parts = False

    def __call__(
        self,
        logits: Float[Tensor, "b c v v"],
        label: UInt8[Tensor, "b c v v"],
        neighbourhood: UInt8[Tensor, "b c v v"],
        counts: Int64[Tensor, "3 c"] | None = None,
    ) -> Result:
        assert counts is None, "the dice loss cannot be computed on micro-batches"
        target = (label > 0).float()
        views = sum_over_ranks(torch.tensor(float(len(label)), device=label.device))
        total = binary_cross_entropy_with_logits(logits.float(), target, reduction="sum")
        bce = total * world_size() / (views * label.shape[-2] * label.shape[-1])
        probabilities = logits.float().sigmoid()
        intersection, total_area = (
            with_other_ranks(cells.sum(dim=(0, 2, 3)))
            for cells in (probabilities * target, probabilities + target)
        )
        dice = (1 - 2 * (intersection + 1) / (total_area + 2)).sum()
        # dice has the value of the whole batch but the gradients of this rank's views only: scaled by world_size, their
        # mean over ranks is the gradient of the whole batch
        loss = bce + dice + (world_size() - 1) * (dice - dice.detach())
        return Result(loss, {"bce": bce.detach(), "dice": dice.detach()})


class Weights(NamedTuple):
    """Weights of the cells, by category.

    Attributes:
        alpha: w_α, weight of label cells.
        gamma: w_γ, weight of the cells without label around the seen part of an object.
    """

    alpha: Float[Tensor, " c"]
    gamma: Float[Tensor, " c"]


def imagination_loss(
    logits: Float[Tensor, "b c v v"],
    label: UInt8[Tensor, "b c v v"],
    neighbourhood: UInt8[Tensor, "b c v v"],
    alpha_max: float = 30.0,
    gamma_max: float = 10.0,
    counts: Int64[Tensor, "3 c"] | None = None,
) -> tuple[Float[Tensor, ""], Weights]:
    """Return the weighted cross-entropy between the imagined map and V_label.

    With p = σ(logits) for V_object, the paper's equations are, separately for each category:

        w_α  = min(N / (#{V_label > 0} + 1), alpha_max)
        w_γ  = min(N / (#{M*_seen > 0 and V_label = 0} + 1), gamma_max)
        W_α  = w_α - 1 where V_label > 0, else 0
        W_γ  = w_γ - 1 where M*_seen > 0 and V_label = 0, else 0
        W    = W_α + W_γ + 1
        L    = mean over the batch of Σ_ij -W_ij (V_label log p + (1 - V_label) log(1 - p))

    Our decisions where the paper is ambiguous:

    - N and both counts are taken over the whole batch ("a large batch size is more beneficial to obtain a stable
      weight matrix") and over all ranks in distributed training: N = B V^2 for B views on all ranks.
    - The paper's "number of occupied cells" in w_γ is the number of cells to which W_γ applies.
    - The sum runs over the V^2 cells of a view, and the mean over the batch's views.
    - The losses of categories that share a network are summed, as those of separate units would be.

    Args:
        logits: logits of the unit.
        label: V_label, 0 or 1.
        neighbourhood: M*_seen of the ground truth, 0 or 1.
        alpha_max, gamma_max: upper bounds of the weights; 1 disables a weight.
        counts: counts of the whole batch if the arguments are a part of it; the losses of all parts then add up to
            the loss of the batch.

    Returns:
        The loss, whose gradients averaged over ranks are those of the whole batch, and the weights.
    """
    positive = label > 0
    around = (neighbourhood > 0) & ~positive
    rank_counts = batch_counts(label, neighbourhood) if counts is None else counts.clone()
    num_views, num_positive, num_around = sum_over_ranks(rank_counts).unbind()
    num_cells = num_views * label.shape[-2] * label.shape[-1]
    w_alpha = (num_cells / (num_positive + 1)).clamp(max=alpha_max)
    w_gamma = (num_cells / (num_around + 1)).clamp(max=gamma_max)
    weight = (w_alpha - 1).view(-1, 1, 1) * positive + (w_gamma - 1).view(-1, 1, 1) * around + 1
    total = binary_cross_entropy_with_logits(logits.float(), positive.float(), weight, reduction="sum")
    # each rank divides by the mean number of views per rank, so that the mean over ranks is the mean over views
    return total * world_size() / num_views[0], Weights(w_alpha, w_gamma)


def batch_counts(
    label: UInt8[Tensor, "b c v v"], neighbourhood: UInt8[Tensor, "b c v v"]
) -> Int64[Tensor, "3 c"]:
    """Return the counts that determine the weights, by category: views, label cells, other neighbourhood cells."""
    positive = label > 0
    views = label.new_full((label.shape[1],), len(label), dtype=torch.long)
    return torch.stack([views, count(positive), count((neighbourhood > 0) & ~positive)])


def count(mask: Bool[Tensor, "b c v v"]) -> Int64[Tensor, " c"]:
    """Count the cells of a mask over the whole batch, by category."""
    return mask.sum(dim=(0, 2, 3))


def with_other_ranks(sums: Tensor) -> Tensor:
    """Sum a tensor over all ranks, with the gradients of this rank only."""
    return sums + (sum_over_ranks(sums.detach().clone()) - sums.detach())
