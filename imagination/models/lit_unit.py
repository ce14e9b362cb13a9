"""LightningModule that trains a unit."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics import Metric

from imagination.geometry.grid import EgoGrid
from imagination.geometry.morphology import kernel_cells
from imagination.models.ego_metrics import THRESHOLDS, EgoScores, best_thresholds, named_scores
from imagination.models.lit_task import Batch, LitTask, ScoreTable
from imagination.models.losses import Loss, batch_counts
from imagination.models.task_kind import TaskKind
from imagination.models.unit import Prediction, Unit
from imagination.utils.errors import UserError, check_range
from imagination.utils.process_group import sum_over_ranks


class LitUnit(LitTask):
    """LightningModule that trains a unit and scores its egocentric maps.

    A batch holds rgb uint8 (B, 3, H, W); depth float16 (B, 1, H, W), metres; occupied and seen uint8 (B, 1, V, V);
    label and neighbourhood (M*_seen of the ground truth) uint8 (B, C, V, V); in a micro-batch, counts int64 (3, C), see
    `batch_counts`, and micro_batches int64 (), their number. Further entries are ignored.

    Args:
        unit: network to train.
        loss: loss between logits and label, e.g. the paper's `WeightedBCE`.
        ego: grid of the maps.
        neighbourhood: side of the kernel ε of M*_seen, metres.
        optimizer: factory of the optimiser, called with the parameters.
        scheduler: factory of the learning-rate scheduler, called with the optimiser; stepped once per epoch.
        valid_threshold: τ_valid, the threshold for M*_seen of a prediction.
        channels_last: whether images and weights use the channels-last memory format.
        compile: whether to train with torch.compile, which needs a C++ compiler and some minutes.

    Raises:
        UserError: if the threshold is out of range, or at the start of training, if batches are split into
            micro-batches with a loss that needs the whole batch.
    """

    kind = TaskKind.MAPS
    target = "label"
    chosen: Tensor

    def __init__(
        self,
        unit: Unit,
        loss: Loss,
        ego: EgoGrid,
        neighbourhood: float,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler],
        valid_threshold: float = 0.5,
        channels_last: bool = True,
        compile: bool = False,
    ) -> None:
        super().__init__(unit.categories, optimizer, scheduler)
        self.unit = unit.to(memory_format=torch.channels_last) if channels_last else unit
        self.compiled = compile
        self.loss = loss
        check_range("model.module.valid_threshold", valid_threshold, 0, 1)
        kernel = kernel_cells(neighbourhood, ego.resolution)
        self.val_scores = EgoScores(len(self.categories), kernel, valid_threshold)
        self.test_scores = EgoScores(len(self.categories), kernel, valid_threshold)
        # index in THRESHOLDS of each category's threshold, selected at each validation and saved in checkpoints
        self.register_buffer("chosen", torch.full((len(self.categories),), len(THRESHOLDS) // 2))

    def forward(self, batch: Batch) -> Float[Tensor, "b c v v"]:
        """Return the logits of a batch."""
        logits: Tensor = self.unit(batch["rgb"], batch["depth"], batch["occupied"], batch["seen"])
        return logits

    @torch.no_grad()
    def predict(self, batch: Batch) -> Prediction:
        """Return the probabilities of V_object of a batch on any device, in evaluation mode and single precision."""
        training = self.training
        self.eval()
        views = [batch[name].to(self.device) for name in ("rgb", "depth", "occupied", "seen")]
        # the unit of a plugin may be any module, which has no raw logits
        raw = self.unit.raw(*views) if isinstance(self.unit, Unit) else self.unit(*views)
        maps = self.unit.postprocess(raw) if isinstance(self.unit, Unit) else raw
        self.train(training)
        return Prediction(maps.float().sigmoid(), raw.float().sigmoid())

    def setup(self, stage: str) -> None:
        if stage != "fit":
            return
        data = getattr(self.trainer, "datamodule", None)
        if (count := getattr(data, "micro_batches", 1)) > 1 and not self.loss.in_parts:
            raise UserError(
                f"data.micro_batches: got {count}, expected 1 for the loss {type(self.loss).__name__}, which needs the "
                "whole batch; set data.micro_batches=1 or model/loss=weighted_bce"
            )
        if self.compiled:
            self.unit.compile()

    def predict_step(self, batch: Batch, index: int = 0) -> Prediction:
        """Return the probabilities of V_object of a batch; see `predict`."""
        return self.predict(batch)

    @property
    def selected_thresholds(self) -> Float[Tensor, " c"]:
        """Threshold of each category's egocentric map."""
        return torch.tensor(THRESHOLDS, device=self.chosen.device)[self.chosen]

    @property
    def score_table(self) -> ScoreTable:
        """Layout of tables/ego.csv: scores over all cells, cells seen by depth, and unseen cells."""
        suffixes = {"all": "", "seen": "_seen", "unseen": "_unseen"}
        return ScoreTable("Egocentric", "ego", "cells", suffixes)

    def training_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss, its weights and the fraction of empty labels."""
        loss, parts = self.loss(self(batch), batch["label"], batch["neighbourhood"], batch.get("counts"))
        # Lightning averages over micro-batches as over accumulated batches, but their losses add up
        loss = loss * batch.get("micro_batches", 1)
        return loss, {**parts, "empty_labels": (batch["label"].amax(dim=(2, 3)) == 0).float().mean()}

    def batch_totals(self, batch: Batch) -> dict[str, Tensor]:
        """Return the counts of the whole batch, from which the loss computes its weights."""
        return {"counts": batch_counts(batch["label"], batch["neighbourhood"])}

    def on_validation_epoch_end(self) -> None:
        self.chosen.copy_(best_thresholds(self.val_scores.compute()))
        self.log("val/threshold", self.selected_thresholds.mean())
        super().on_validation_epoch_end()

    def score(self, batch: Batch, stage: str, scores: Metric) -> None:
        """Log the loss of a batch and count its cells."""
        logits = self(batch).float()
        loss, _ = self.loss(logits, batch["label"], batch["neighbourhood"])
        # each rank is weighted by the views of all ranks, because its loss is already scaled by its fraction of them
        views = sum_over_ranks(torch.tensor(len(logits), device=logits.device))
        self.log(f"{stage}/loss", loss, batch_size=int(views), sync_dist=True)
        scores.update(logits.sigmoid(), batch["label"], batch["seen"])

    def named_scores(self, scores: Metric) -> dict[str, Tensor]:
        """Return the scores at the selected thresholds."""
        return named_scores(scores.compute(), self.chosen, self.categories)
