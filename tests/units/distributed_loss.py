"""Run by test_loss.py in two processes: loss and gradients must be those of one process with all views."""

import torch
from torch import distributed, nn

from imagination.units.loss import imagination_loss
from tests.units.batches import random_batch

SHARES = (slice(0, 2), slice(2, 7))  # unequal, and the views differ in how much label they hold


def main() -> None:
    batch = random_batch(views=7, cells=9)
    batch["label"][3:] = 0
    logits_in = torch.randn(7, 1, 9, 9, generator=torch.Generator().manual_seed(1))

    def step(network: nn.Module, views: slice) -> tuple[torch.Tensor, torch.Tensor]:
        loss, weights = imagination_loss(
            network(logits_in[views]), batch["label"][views], batch["neighbourhood"][views]
        )
        loss.backward()
        return loss.detach(), torch.cat(list(weights))

    torch.manual_seed(0)
    alone = nn.Conv2d(1, 1, 3, padding=1)
    loss_alone, weights_alone = step(alone, slice(0, 7))  # before there is a process group

    distributed.init_process_group("gloo")
    torch.manual_seed(0)
    network = nn.Conv2d(1, 1, 3, padding=1)
    loss, weights = step(network, SHARES[distributed.get_rank()])
    # the mean over ranks, which is what DistributedDataParallel takes; its wrapper now and then aborts a gloo process
    # at exit (torch 2.14), long after the results agreed
    for value in (loss, *(weight.grad for weight in network.parameters())):
        distributed.all_reduce(value)
        value /= 2
    torch.testing.assert_close(weights, weights_alone)
    torch.testing.assert_close(loss, loss_alone)
    for ours, expected in zip(network.parameters(), alone.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, expected.grad)
    distributed.destroy_process_group()


main()
