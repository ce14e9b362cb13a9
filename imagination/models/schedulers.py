"""The learning rate over the epochs."""

from torch import Tensor
from torch.optim.lr_scheduler import CosineAnnealingLR


class CosineAnnealing(CosineAnnealingLR):
    """Cosine annealing that stays at its end: a run that goes on for more epochs than planned keeps the final rate.

    PyTorch's own rises again after T_max.
    """

    def get_lr(self) -> list[float | Tensor]:
        if self.last_epoch > self.T_max:
            return [group["lr"] for group in self.optimizer.param_groups]
        return super().get_lr()
