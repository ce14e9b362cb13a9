"""LightningModule that trains a network for first-person segmentation."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import cross_entropy
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics import Metric
from torchmetrics.classification import MulticlassConfusionMatrix

from imagination.models.lit_task import Batch, LitTask, ScoreTable
from imagination.models.segmentation.hrnet import at_size
from imagination.models.task_kind import TaskKind
from imagination.models.tta_hflip import average_with_hflip


class LitSegmentation(LitTask):
    """LightningModule that trains a network with cross-entropy and scores its segmentations by IoU.

    A batch holds rgb uint8 (B, 3, H, W); segmentation uint8 (B, H, W), 0 for background, else category index + 1; in a
    micro-batch, views and micro_batches int64 (), the number of views and of micro-batches in the whole batch.

    Args:
        network: factory of the network, called with the number of `classes`: background and each category.
        categories: names of the categories.
        optimizer: factory of the optimiser, called with the parameters.
        scheduler: factory of the learning-rate scheduler, called with the optimiser; stepped once per epoch.
        tta_hflip: whether to use horizontal-flip test-time augmentation in evaluation mode.
    """

    kind = TaskKind.IMAGES
    target = "segmentation"

    def __init__(
        self,
        network: Callable[..., nn.Module],
        categories: Sequence[str],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler],
        tta_hflip: bool = False,
    ) -> None:
        super().__init__(categories, optimizer, scheduler)
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

    def predict_step(self, batch: Batch, index: int = 0) -> UInt8[Tensor, "b h w"]:
        """Return the segmentations of a batch, at the size of the images; see `segment`."""
        return self.segment(batch["rgb"], *batch["rgb"].shape[-2:])

    @property
    def score_table(self) -> ScoreTable:
        """Layout of tables/first_person.csv: scores of each category and their mean."""
        suffixes = {"mean": ""} | {name: f"_{name}" for name in self.categories}
        return ScoreTable("First-person", "first_person", "category", suffixes)

    def training_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss."""
        loss, _ = self.compare(batch)
        if "views" in batch:  # Lightning averages over micro-batches, whose sizes may differ by a view
            loss = loss * len(batch["rgb"]) * batch["micro_batches"] / batch["views"]
        return loss, {}

    def batch_totals(self, batch: Batch) -> dict[str, Tensor]:
        """Return the number of views in the whole batch."""
        return {"views": torch.tensor(len(batch["rgb"]))}

    def compare(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the loss and the most probable class of each pixel."""
        gt = batch["segmentation"].long()
        logits = at_size(self(batch["rgb"]), *gt.shape[-2:])
        # flattened to pixels, because GPUs sum the loss of images in a random order
        total = cross_entropy(logits.permute(0, 2, 3, 1).flatten(0, 2), gt.flatten(), reduction="sum")
        return total / max(1, gt.numel()), logits.argmax(dim=1)  # a rank may have no view

    def score(self, batch: Batch, stage: str, scores: Metric) -> None:
        """Log the loss of a batch and count its pixels."""
        loss, predicted = self.compare(batch)
        self.log(f"{stage}/loss", loss, batch_size=len(predicted), sync_dist=True)
        scores.update(predicted, batch["segmentation"].long())

    def named_scores(self, scores: Metric) -> dict[str, Tensor]:
        """Return IoU, precision and recall of each category and their means, without the background."""
        counts: Tensor = scores.compute()
        correct, gt, predicted = (
            count[1:] for count in (counts.diagonal(), counts.sum(dim=1), counts.sum(dim=0))
        )
        named = {
            "iou": correct / (gt + predicted - correct).clamp(min=1),
            "precision": correct / predicted.clamp(min=1),
            "recall": correct / gt.clamp(min=1),
        }
        means = {name: values.mean() for name, values in named.items()}
        by_category = {
            f"{name}_{category}": value
            for name, values in named.items()
            for category, value in zip(self.categories, values, strict=True)
        }
        return means | by_category
