"""Learning-rate schedulers."""

from torch import Tensor
from torch.optim.lr_scheduler import CosineAnnealingLR


class CosineAnnealing(CosineAnnealingLR):
    """Cosine annealing that keeps the final learning rate after `T_max` epochs, where PyTorch's rate rises again."""

    def get_lr(self) -> list[float | Tensor]:
        if self.last_epoch > self.T_max:
            return [group["lr"] for group in self.optimizer.param_groups]
        return super().get_lr()
