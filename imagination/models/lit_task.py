"""Base class of the LightningModules: what mapping and first-person segmentation have in common."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pkgutil import resolve_name
from typing import Any, ClassVar, NamedTuple, TypeVar, cast

import torch
from lightning import LightningModule
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics import Metric

from imagination.models.task_kind import TaskKind
from imagination.utils.errors import UserError

Task = TypeVar("Task", bound="LitTask")

Batch = Mapping[str, Tensor]
"""Batch of the data module; see `imagination.data.collate`."""

LOADER = "imagination.runs.checkpoint:load"
"""Function that builds a module from a checkpoint. It is imported at its first use, because it composes the config,
which models do not know."""


class ScoreTable(NamedTuple):
    """Layout of the table of scores on single views.

    Attributes:
        title: adjective of the scores in messages.
        name: file name without suffix.
        column: name of the first column.
        suffixes: suffix of the logged scores by row.
    """

    title: str
    name: str
    column: str
    suffixes: Mapping[str, str]


class LitTask(LightningModule, ABC):
    """Base class of the tasks that are trained: `LitUnit` and `LitSegmentation`.

    The hyperparameters in a checkpoint are the overrides and plain values of the run's config (`choices` and `values`).

    Args:
        categories: names of the predicted categories.
        optimizer: factory of the optimiser, called with the parameters.
        scheduler: factory of the learning-rate scheduler, called with the optimiser; stepped once per epoch.
    """

    kind: ClassVar[TaskKind]
    target: ClassVar[str]
    """Entry of a batch that marks the cells or pixels of the categories."""

    val_scores: Metric
    test_scores: Metric

    def __init__(
        self,
        categories: Sequence[str],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler],
    ) -> None:
        super().__init__()
        self.categories = list(categories)
        self.optimizer = optimizer
        self.scheduler = scheduler

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]  # no hparams_file, and never more than plain data
        cls: type[Task], checkpoint_path: str | PathLike[str], map_location: str | torch.device = "cpu"
    ) -> Task:
        """Return the trained module of a checkpoint in evaluation mode; nothing is unpickled.

        The network is composed from the installed conf and plugins with the overrides and values in the checkpoint.

        Raises:
            UserError: if the file cannot be read, holds more than plain data, or is of another task.
        """
        module = cast(LitTask, resolve_name(LOADER)(checkpoint_path))
        if not isinstance(module, cls):
            raise UserError(
                f"checkpoint {checkpoint_path}: got a {type(module).__name__}, expected a {cls.__name__}; call "
                f"{type(module).__name__}.load_from_checkpoint"
            )
        return module.to(map_location)

    @abstractmethod
    def training_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of a batch or micro-batch, and further values to log."""

    @abstractmethod
    def batch_totals(self, batch: Batch) -> dict[str, Tensor]:
        """Return the entries of a micro-batch that describe its whole batch, which scale the loss."""

    @abstractmethod
    def predict_step(self, batch: Batch, index: int = 0) -> Any:
        """Return the predictions for the views of a batch."""

    @property
    @abstractmethod
    def score_table(self) -> ScoreTable:
        """Layout of the table of scores on single views."""

    @abstractmethod
    def score(self, batch: Batch, stage: str, scores: Metric) -> None:
        """Log the loss of a validation or test batch and add its predictions to the scores."""

    @abstractmethod
    def named_scores(self, scores: Metric) -> dict[str, Tensor]:
        """Return the scores over all batches and ranks, e.g. `iou`, `precision`, `recall`."""

    def training_step(self, batch: Batch, index: int) -> Tensor:
        loss, values = self.training_loss(batch)
        self.log_dict(
            {f"train/{name}": value for name, value in {"loss": loss, **values}.items()},
            batch_size=len(batch["rgb"]),
            sync_dist=True,
        )
        return loss

    def validation_step(self, batch: Batch, index: int) -> None:
        self.score(batch, "val", self.val_scores)

    def test_step(self, batch: Batch, index: int) -> None:
        self.score(batch, "test", self.test_scores)

    def on_validation_epoch_end(self) -> None:
        self._log_scores("val", self.val_scores)

    def on_test_epoch_end(self) -> None:
        self._log_scores("test", self.test_scores)

    def configure_optimizers(self) -> Any:  # Lightning's return type is a large union
        optimizer = self.optimizer(self.parameters())
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": self.scheduler(optimizer), "name": "lr"},  # tag in the loggers
        }

    def _log_scores(self, stage: str, scores: Metric) -> None:
        self.log_dict({f"{stage}/{name}": value for name, value in self.named_scores(scores).items()})
        scores.reset()
