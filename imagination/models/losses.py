"""Losses on logits: the paper's weighted binary cross-entropy (section III-B), and cross-entropy with batch dice."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from imagination.utils.errors import check_range
from imagination.utils.process_group import sum_over_ranks, world_size


class Result(NamedTuple):
    """What a loss gives.

    Attributes:
        loss: whose gradients, averaged over ranks, are those of the whole batch.
        parts: what it is made of, for the log.
    """

    loss: Float[Tensor, ""]
    parts: dict[str, Tensor]


@runtime_checkable
class Loss(Protocol):
    """How far imagined maps are from what they should be; categories add up.

    Attributes:
        in_parts: whether the loss of a batch is the sum of its parts', given the counts of the whole.
    """

    in_parts: ClassVar[bool]

    def __call__(
        self,
        logits: Float[Tensor, "b c v v"],
        label: UInt8[Tensor, "b c v v"],
        neighbourhood: UInt8[Tensor, "b c v v"],
        counts: Int64[Tensor, "3 c"] | None = None,
    ) -> Result:
        """The loss of a batch or, with `counts`, of a part of one; arguments as of `imagination_loss`."""


@dataclass(frozen=True)
class WeightedBCE:
    """The paper's; see `imagination_loss`.

    Attributes:
        alpha_max, gamma_max: caps of the weights.

    Raises:
        UserError: if a cap is out of range.
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
    """Binary cross-entropy, the mean over all cells, plus the dice loss of the whole batch; not the paper's.

    With p = σ(logits) and y = V_label, for each category by itself, sums over all cells of all views:

        dice = 1 - 2 (Σ p y + 1) / (Σ p + Σ y + 2)

    (Milletari et al. 2016, V-Net, with the squares in the denominator left out.) The batch is taken as one picture,
    since a single view often has no label at all. The ones keep a batch without any label from having no gradient.

    Its gradient at one view depends on what is imagined in all others, so it cannot be computed in parts.
    """

    in_parts = False

    def __call__(
        self,
        logits: Float[Tensor, "b c v v"],
        label: UInt8[Tensor, "b c v v"],
        neighbourhood: UInt8[Tensor, "b c v v"],
        counts: Int64[Tensor, "3 c"] | None = None,
    ) -> Result:
        assert counts is None, "dice has no parts"
        target = (label > 0).float()
        views = sum_over_ranks(torch.tensor(float(len(label)), device=label.device))
        total = binary_cross_entropy_with_logits(logits.float(), target, reduction="sum")
        bce = total * world_size() / (views * label.shape[-2] * label.shape[-1])
        imagined = logits.float().sigmoid()
        both, either = (
            with_other_ranks(cells.sum(dim=(0, 2, 3))) for cells in (imagined * target, imagined + target)
        )
        dice = (1 - 2 * (both + 1) / (either + 2)).sum()
        # every rank has the whole batch's dice, but gradients of its own views alone; the mean over ranks has all
        loss = bce + dice + (world_size() - 1) * (dice - dice.detach())
        return Result(loss, {"bce": bce.detach(), "dice": dice.detach()})


class Weights(NamedTuple):
    """Weights of cells, one of each for every category.

    Attributes:
        alpha: w_α, of the cells of the label.
        gamma: w_γ, of the cells around the seen part of an object that are not label.
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
    """Weighted cross-entropy between the imagined map and V_label.

    With p = σ(logits) for V_object, the paper's equations, for each category by itself:

        w_α  = min(N / (#{V_label > 0} + 1), alpha_max)
        w_γ  = min(N / (#{M*_seen > 0 and V_label = 0} + 1), gamma_max)
        W_α  = w_α - 1 where V_label > 0, else 0
        W_γ  = w_γ - 1 where M*_seen > 0 and V_label = 0, else 0
        W    = W_α + W_γ + 1
        L    = mean over the batch of Σ_ij -W_ij (V_label log p + (1 - V_label) log(1 - p))

    The paper leaves open, and we settled:

    - N and both counts are taken over the whole batch, "a large batch size is more beneficial to obtain a stable
      weight matrix", and over all ranks where training is distributed: N = B V^2 for B views on all of them.
    - The paper's "number of occupied cells" in w_γ is the number of cells that W_γ weighs.
    - The sum runs over the V^2 cells of a view, and the mean over the batch's views.
    - Categories that share a network add up, as the losses of their units would.

    Args:
        logits: of the unit.
        label: V_label, 0 or 1.
        neighbourhood: M*_seen made from the truth, 0 or 1.
        alpha_max, gamma_max: caps of the weights; 1 switches a weight off.
        counts: of the whole batch, where this is a part of it; the parts' losses then add up to the batch's.

    Returns:
        The loss, whose gradients average over ranks to those of the whole batch, and the weights.
    """
    positive = label > 0
    around = (neighbourhood > 0) & ~positive
    own = batch_counts(label, neighbourhood) if counts is None else counts.clone()
    views, positives, arounds = sum_over_ranks(own).unbind()
    cells = views * label.shape[-2] * label.shape[-1]
    w_alpha = (cells / (positives + 1)).clamp(max=alpha_max)
    w_gamma = (cells / (arounds + 1)).clamp(max=gamma_max)
    weight = (w_alpha - 1).view(-1, 1, 1) * positive + (w_gamma - 1).view(-1, 1, 1) * around + 1
    total = binary_cross_entropy_with_logits(logits.float(), positive.float(), weight, reduction="sum")
    # each rank divides by its share of all views, so that the mean over ranks is the mean over views
    return total * world_size() / views[0], Weights(w_alpha, w_gamma)


def batch_counts(
    label: UInt8[Tensor, "b c v v"], neighbourhood: UInt8[Tensor, "b c v v"]
) -> Int64[Tensor, "3 c"]:
    """What the weights are made of: views, cells of the label and cells around it, of each category."""
    positive = label > 0
    views = label.new_full((label.shape[1],), len(label), dtype=torch.long)
    return torch.stack([views, count(positive), count((neighbourhood > 0) & ~positive)])


def count(mask: Bool[Tensor, "b c v v"]) -> Int64[Tensor, " c"]:
    """Cells of a mask over the whole batch, by category."""
    return mask.sum(dim=(0, 2, 3))


def with_other_ranks(sums: Tensor) -> Tensor:
    """The sum of a tensor over all processes, with this one's gradients."""
    return sums + (sum_over_ranks(sums.detach().clone()) - sums.detach())
