"""LightningModule that trains a network for first-person segmentation."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float, UInt8
from lightning import LightningModule
from torch import Tensor, nn
from torch.nn.functional import cross_entropy
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics.classification import MulticlassConfusionMatrix

from imagination.models.segmentation.hrnet import at_size
from imagination.models.tta_hflip import average_with_hflip

Batch = Mapping[str, Tensor]
"""rgb uint8 (B, 3, H, W); segmentation uint8 (B, H, W), 0 for background, else category index + 1; views and
micro_batches int64 () in a micro-batch, the number of views and of micro-batches in the whole batch."""


class LitSegmentation(LightningModule):
    """LightningModule that trains a network with cross-entropy and scores its segmentations by IoU.

    Args:
        network: factory of the network, called with the number of `classes`: background and each category.
        categories: names of the categories.
        optimizer: factory of the optimiser, called with the parameters.
        scheduler: factory of the learning-rate scheduler, called with the optimiser; stepped once per epoch.
        tta_hflip: whether to use horizontal-flip test-time augmentation in evaluation mode.
    """

    def __init__(
        self,
        network: Callable[..., nn.Module],
        categories: Sequence[str],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler],
        tta_hflip: bool = False,
    ) -> None:
        super().__init__()
        self.categories = list(categories)
        self.optimizer = optimizer
        self.scheduler = scheduler
        self.tta_hflip = tta_hflip
        classes = 1 + len(self.categories)
        self.network = network(classes=classes)
        self.val_scores = MulticlassConfusionMatrix(classes)
        self.test_scores = MulticlassConfusionMatrix(classes)

    @torch.no_grad()
    def segment(
        self, rgb: UInt8[Tensor, "b 3 h w"], rows: int, columns: int
    ) -> UInt8[Tensor, "b rows columns"]:
        """Return the most probable class of each pixel at the given size: 0 for background, else category index + 1."""
        training = self.training
        self.eval()
        classes = at_size(self(rgb.to(self.device)), rows, columns).argmax(dim=1)
        self.train(training)
        return classes.to(torch.uint8)

    def forward(self, rgb: UInt8[Tensor, "b 3 h w"]) -> Float[Tensor, "b k p q"]:
        """Return the logits of the classes, at the output size of the network."""
        if self.tta_hflip and not self.training:
            return average_with_hflip(self.network, rgb)
        logits: Tensor = self.network(rgb)
        return logits

    def training_step(self, batch: Batch, index: int) -> Tensor:
        loss, _ = self.compare(batch)
        if "views" in batch:  # Lightning averages over micro-batches, whose sizes may differ by a view
            loss = loss * len(batch["rgb"]) * batch["micro_batches"] / batch["views"]
        values = {"loss": loss, "learning_rate": self.trainer.optimizers[0].param_groups[0]["lr"]}
        self.log_dict(
            {f"train/{name}": value for name, value in values.items()},
            batch_size=len(batch["rgb"]),
            sync_dist=True,
        )
        return loss

    def validation_step(self, batch: Batch, index: int) -> None:
        self._score(batch, "val", self.val_scores)

    def test_step(self, batch: Batch, index: int) -> None:
        self._score(batch, "test", self.test_scores)

    def on_validation_epoch_end(self) -> None:
        self._log_scores("val", self.val_scores)

    def on_test_epoch_end(self) -> None:
        self._log_scores("test", self.test_scores)

    def configure_optimizers(self) -> Any:  # Lightning's return type is a large union
        optimizer = self.optimizer(self.parameters())
        return {"optimizer": optimizer, "lr_scheduler": self.scheduler(optimizer)}

    def compare(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the loss and the most probable class of each pixel."""
        gt = batch["segmentation"].long()
        logits = at_size(self(batch["rgb"]), *gt.shape[-2:])
        # flattened to pixels, because GPUs sum the loss of images in a random order
        total = cross_entropy(logits.permute(0, 2, 3, 1).flatten(0, 2), gt.flatten(), reduction="sum")
        return total / max(1, gt.numel()), logits.argmax(dim=1)  # a rank may have no view

    def _score(self, batch: Batch, stage: str, scores: MulticlassConfusionMatrix) -> None:
        loss, predicted = self.compare(batch)
        self.log(f"{stage}/loss", loss, batch_size=len(predicted), sync_dist=True)
        scores.update(predicted, batch["segmentation"].long())

    def _log_scores(self, stage: str, scores: MulticlassConfusionMatrix) -> None:
        """Log IoU, precision and recall of each category and their means, without the background."""
        counts: Tensor = scores.compute()
        correct, gt, predicted = (
            count[1:] for count in (counts.diagonal(), counts.sum(dim=1), counts.sum(dim=0))
        )
        named = {
            "iou": correct / (gt + predicted - correct).clamp(min=1),
            "precision": correct / predicted.clamp(min=1),
            "recall": correct / gt.clamp(min=1),
        }
        for name, values in named.items():
            self.log(f"{stage}/{name}", values.mean())
            for category, value in zip(self.categories, values, strict=True):
                self.log(f"{stage}/{name}_{category}", value)
        scores.reset()
