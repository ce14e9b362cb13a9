"""Run by test_losses.py in two processes: loss and gradients must equal those of one process with all views."""

import torch
from torch import distributed, nn

from imagination.models.losses import BCEDice, Loss, WeightedBCE
from tests.helpers.batches import random_batch

VIEWS_OF_RANK = (slice(0, 2), slice(2, 7))  # of unequal sizes and with different numbers of label cells


def main() -> None:
    batch = random_batch(views=7, cells=9)
    batch["label"][3:] = 0
    logits_in = torch.randn(7, 1, 9, 9, generator=torch.Generator().manual_seed(1))

    def step(network: nn.Module, loss: Loss, views: slice) -> tuple[torch.Tensor, torch.Tensor]:
        result = loss(network(logits_in[views]), batch["label"][views], batch["neighbourhood"][views])
        result.loss.backward()
        return result.loss.detach(), torch.stack(list(result.parts.values()))

    losses = [WeightedBCE(), BCEDice()]
    torch.manual_seed(0)
    alone = [nn.Conv2d(1, 1, 3, padding=1) for _ in losses]
    # before the process group is initialised
    single = [step(*pair, slice(0, 7)) for pair in zip(alone, losses, strict=True)]

    distributed.init_process_group("gloo")
    torch.manual_seed(0)
    for loss, expected, (loss_alone, parts_alone) in zip(losses, alone, single, strict=True):
        network = nn.Conv2d(1, 1, 3, padding=1)
        value, parts = step(network, loss, VIEWS_OF_RANK[distributed.get_rank()])
        # the mean over ranks, as in DistributedDataParallel, whose wrapper sometimes aborts a gloo process at exit
        # (torch 2.14)
        for tensor in (value, parts, *(weight.grad for weight in network.parameters())):
            distributed.all_reduce(tensor)
            tensor /= 2
        torch.testing.assert_close(parts, parts_alone)
        torch.testing.assert_close(value, loss_alone)
        for ours, weight in zip(network.parameters(), expected.parameters(), strict=True):
            torch.testing.assert_close(ours.grad, weight.grad)
    distributed.destroy_process_group()


main()
