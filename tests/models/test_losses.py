"""Losses, compared with values computed by hand, a loop, and two processes."""

import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from imagination.data.batches import parts
from imagination.models.losses import BCEDice, WeightedBCE, batch_counts, imagination_loss
from tests.helpers.batches import random_batch


def masks(views: int, cells: int, label: dict[int, int], around: dict[int, int]) -> tuple[Tensor, Tensor]:
    """Return label and neighbourhood with given numbers of cells per view; the neighbourhood includes the label."""
    maps = torch.zeros(2, views, 1, cells * cells, dtype=torch.uint8)
    for view, count in label.items():
        maps[:, view, 0, :count] = 1
    for view, count in around.items():
        maps[1, view, 0, label.get(view, 0) : label.get(view, 0) + count] = 1
    return maps[0].view(views, 1, cells, cells), maps[1].view(views, 1, cells, cells)


def split(batch: dict[str, Tensor], count: int) -> Iterator[dict[str, Tensor]]:
    """Yield micro-batches with the counts of the whole batch, as LitUnit.batch_totals adds them."""
    return parts(batch, count, lambda whole: {"counts": batch_counts(whole["label"], whole["neighbourhood"])})


def test_by_hand_with_no_cap_and_counts_of_the_batch() -> None:
    # 2 views of 4 x 4: N = 32. Label: 3 cells, all in view 0. Around: 1 cell in view 0, 6 in view 1.
    label, neighbourhood = masks(2, 4, {0: 3}, {0: 1, 1: 6})
    loss, weights = imagination_loss(torch.zeros(2, 1, 4, 4), label, neighbourhood)
    assert weights.alpha.tolist() == [32 / 4]  # counted in view 0 alone it would be 16 / 4
    assert weights.gamma.tolist() == [32 / 8]
    # logits of 0 cost ln 2 a cell: 3 cells weigh 8, 7 weigh 4, 22 weigh 1; the mean is over 2 views
    assert loss.item() == pytest.approx((3 * 8 + 7 * 4 + 22) * math.log(2) / 2)


def test_by_hand_with_logits() -> None:
    label, neighbourhood = masks(1, 2, {0: 1}, {0: 1})  # weights 4 / 2 = 2, 2, 1, 1
    logits = torch.tensor([[[[2.0, -1.0], [0.5, -3.0]]]])
    loss, _ = imagination_loss(logits, label, neighbourhood)
    expected = 2 * math.log(1 + math.exp(-2)) + 2 * math.log(1 + math.exp(-1))
    expected += math.log(1 + math.exp(0.5)) + math.log(1 + math.exp(-3))
    assert loss.item() == pytest.approx(expected)


def test_caps() -> None:
    label, neighbourhood = masks(1, 20, {0: 1}, {0: 1})
    _, weights = imagination_loss(torch.zeros(1, 1, 20, 20), label, neighbourhood)
    assert (weights.alpha.item(), weights.gamma.item()) == (30, 10)
    _, weights = imagination_loss(torch.zeros(1, 1, 20, 20), label, neighbourhood, alpha_max=7, gamma_max=3)
    assert (weights.alpha.item(), weights.gamma.item()) == (7, 3)
    _, weights = imagination_loss(
        torch.zeros(1, 1, 20, 20), label, neighbourhood, alpha_max=1000, gamma_max=1000
    )
    assert (weights.alpha.item(), weights.gamma.item()) == (200, 200)


def loss_by_loop(
    logits: Tensor, label: Tensor, neighbourhood: Tensor, alpha_max: float, gamma_max: float
) -> float:
    """Compute the paper's equations cell by cell, on probabilities."""
    total, (views, categories, cells, _) = 0.0, label.shape
    for category in range(categories):
        target = label[:, category].flatten().tolist()
        near = neighbourhood[:, category].flatten().tolist()
        n = views * cells * cells
        w_alpha = min(n / (sum(target) + 1), alpha_max)
        w_gamma = min(n / (sum(m > 0 and y == 0 for m, y in zip(near, target, strict=True)) + 1), gamma_max)
        for x, y, m in zip(logits[:, category].double().flatten().tolist(), target, near, strict=True):
            p = 1 / (1 + math.exp(-x))
            weight = (w_alpha - 1 if y > 0 else 0) + (w_gamma - 1 if m > 0 and y == 0 else 0) + 1
            total -= weight * (y * math.log(p) + (1 - y) * math.log(1 - p))
    return total / views


@settings(max_examples=30, deadline=None)
@given(
    views=st.integers(1, 4),
    categories=st.integers(1, 3),
    cells=st.sampled_from([3, 7]),
    caps=st.tuples(st.floats(1, 40), st.floats(1, 40)),
    seed=st.integers(0, 1000),
)
def test_equals_a_loop(views: int, categories: int, cells: int, caps: tuple[float, float], seed: int) -> None:
    batch = random_batch(views, 8, cells, categories, seed=seed)
    logits = 3 * torch.randn(views, categories, cells, cells, generator=torch.Generator().manual_seed(seed))
    loss, _ = imagination_loss(logits, batch["label"], batch["neighbourhood"], *caps)
    expected = loss_by_loop(logits, batch["label"], batch["neighbourhood"], *caps)
    assert loss.item() == pytest.approx(expected, rel=1e-4)


def test_categories_are_counted_apart_and_add_up() -> None:
    batch = random_batch(3, 8, 9, 3)
    logits = torch.randn(3, 3, 9, 9)
    together, weights = imagination_loss(logits, batch["label"], batch["neighbourhood"])
    alone = [
        imagination_loss(
            logits[:, c : c + 1], batch["label"][:, c : c + 1], batch["neighbourhood"][:, c : c + 1]
        )
        for c in range(3)
    ]
    torch.testing.assert_close(together, sum(loss for loss, _ in alone))
    torch.testing.assert_close(weights.alpha, torch.cat([each.alpha for _, each in alone]))


def test_certain_and_wrong_stays_finite() -> None:
    label, neighbourhood = masks(1, 4, {0: 3}, {0: 3})
    logits = torch.where(label > 0, -300.0, 300.0).requires_grad_()
    loss, _ = imagination_loss(logits, label, neighbourhood)
    loss.backward()
    assert loss.isfinite() and logits.grad is not None and logits.grad.isfinite().all()


@pytest.mark.parametrize("count", [2, 3, 5])
def test_parts_of_a_batch_add_up_to_it(count: int) -> None:
    """In gradient accumulation, the weights of a part are those of the whole batch, for any distribution of labels."""
    batch = random_batch(views=7, cells=9, categories=2)
    batch["label"][2:] = 0
    batch["logits"] = torch.randn(7, 2, 9, 9)
    logits = batch.pop("logits").requires_grad_()
    whole, weights = imagination_loss(logits, batch["label"], batch["neighbourhood"])
    (expected,) = torch.autograd.grad(whole, logits)
    total, gradient = torch.zeros(()), torch.zeros_like(logits)
    for part in split({**batch, "logits": logits}, count):
        loss, part_weights = imagination_loss(
            part["logits"], part["label"], part["neighbourhood"], counts=part["counts"]
        )
        torch.testing.assert_close(part_weights, weights)
        total = total + loss.detach()
        gradient = gradient + torch.autograd.grad(loss, logits)[0]
    torch.testing.assert_close(total, whole.detach())
    torch.testing.assert_close(gradient, expected)
    first = next(split(batch, count))
    _, own = imagination_loss(torch.zeros(first["label"].shape), first["label"], first["neighbourhood"])
    assert not torch.allclose(own.alpha, weights.alpha)  # the weights of the part alone differ


@pytest.mark.slow
def test_two_processes_train_as_one() -> None:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += ["-m", "tests.helpers.distributed_loss"]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


def test_weighted_bce_equals_the_function() -> None:
    batch = random_batch(views=3, cells=9, categories=2)
    logits = torch.randn(3, 2, 9, 9, generator=torch.Generator().manual_seed(0))
    expected, weights = imagination_loss(logits, batch["label"], batch["neighbourhood"], 7.0, 3.0)
    loss, logged = WeightedBCE(7.0, 3.0)(logits, batch["label"], batch["neighbourhood"])
    assert loss == expected
    assert logged["w_alpha"] == weights.alpha.mean() and logged["w_gamma"] == weights.gamma.mean()
    own = [
        WeightedBCE(7.0, 3.0)(part["logits"], part["label"], part["neighbourhood"], part["counts"])
        for part in split({**batch, "logits": logits}, 2)
    ]
    torch.testing.assert_close(own[0].loss + own[1].loss, expected)
    assert all(part.parts["w_gamma"] == weights.gamma.mean() for part in own)


def test_dice_by_hand_sums_over_the_whole_batch() -> None:
    label = torch.zeros(2, 1, 2, 2, dtype=torch.uint8)
    label[0, 0, 0] = 1  # the second view has no label: its own dice loss would be nearly 1
    logits = torch.tensor([[[[0.0, math.log(3)], [0.0, -math.log(3)]]], [[[0.0, 0.0], [0.0, 0.0]]]])
    # probabilities 1/2, 3/4 on the label and 1/2, 1/4, 4 x 1/2 elsewhere
    intersection, total_area = 1 / 2 + 3 / 4, (1 / 2 + 3 / 4) + (1 / 2 + 1 / 4 + 4 / 2) + 2
    bce = -(6 * math.log(1 / 2) + 2 * math.log(3 / 4)) / 8
    loss, parts = BCEDice()(logits, label, label)
    assert parts["dice"].item() == pytest.approx(1 - 2 * (intersection + 1) / (total_area + 2))
    assert parts["bce"].item() == pytest.approx(bce)
    assert loss.item() == pytest.approx(parts["dice"].item() + bce)


def test_dice_of_categories_adds_up_and_a_batch_without_label_has_gradients() -> None:
    batch = random_batch(views=3, cells=9, categories=2)
    logits = torch.randn(3, 2, 9, 9, generator=torch.Generator().manual_seed(0))
    apart = [BCEDice()(logits[:, [k]], batch["label"][:, [k]], batch["label"][:, [k]]).loss for k in (0, 1)]
    assert BCEDice()(logits, batch["label"], batch["label"]).loss.item() == pytest.approx(sum(apart).item())
    logits.requires_grad_()
    BCEDice()(logits, torch.zeros_like(batch["label"]), batch["label"]).loss.backward()
    assert (logits.grad > 0).all()  # all predictions should decrease
