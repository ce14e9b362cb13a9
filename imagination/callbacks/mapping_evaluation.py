"""The mapping task as a callback: a few validation homes while training, all test homes at its end."""

from dataclasses import replace
from pathlib import Path
from typing import cast

from lightning import Callback, LightningModule, Trainer

from imagination.callbacks.unit_images import add_image
from imagination.data.datamodule import SceneData
from imagination.evaluation.prediction import Model, Segmenter
from imagination.evaluation.protocol import MappingProtocol, Subject
from imagination.evaluation.run import evaluate, subject_of
from imagination.reporting.figures.maps import side_by_side
from imagination.reporting.results_folder import write_results
from imagination.utils.errors import check_range
from imagination.utils.timing import stage

Network = Model | Segmenter


class MappingEvaluation(Callback):
    """Logs the global IoU of each approach; writes tables and figures once the test is done.

    While training, the same few validation homes serve to choose thresholds and to measure, with one viewpoint set
    each: these figures are a little too high, and only show how training goes.

    Args:
        protocol: of the evaluation.
        every_n_rounds: rounds between evaluations during training.
        homes: validation homes of each of these.
        folder: of the run; tables/ and figures/ are made in it.
    """

    def __init__(
        self, protocol: MappingProtocol, every_n_rounds: int, homes: int, folder: str | Path
    ) -> None:
        self.protocol = protocol
        self.every_n_rounds = int(
            check_range("mapping_evaluation.every_n_rounds", every_n_rounds, 1, 1_000_000)
        )
        self.homes = int(check_range("mapping_evaluation.homes", homes, 1, 100_000))
        self.folder = Path(folder)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        networks = self._subject(trainer, pl_module).predict
        self.protocol.available(networks.gives)  # refused before training, not after it

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if (trainer.current_epoch + 1) % self.every_n_rounds == 0 and trainer.is_global_zero:
            with stage("evaluation"):
                self._monitor(trainer, pl_module)

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        evaluation = evaluate(self.protocol, _data(trainer), [cast(Network, pl_module)], self.folder)
        for row in write_results(self.folder, evaluation):
            tag = f"global/{row['category']}/{row['approach']}/{row['cell_width']}m"
            pl_module.log(tag, float(row["iou_pooled"]), rank_zero_only=True)
        for example in evaluation.report.examples:
            add_image(trainer, f"maps/{example.category}/{example.run.cell_width:g}m", side_by_side(example))

    def _subject(self, trainer: Trainer, pl_module: LightningModule) -> Subject:
        """The network with its weights of this moment: what is found with them is not kept."""
        return subject_of(_data(trainer), [cast(Network, pl_module)], self.protocol.precision, keep=False)

    def _monitor(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data = _data(trainer)
        subject = self._subject(trainer, pl_module)
        every = data.observer.source.scenes("val")
        furnished = [
            home for home in every if data.observer.truth(home).truth[data.layers].any(axis=(1, 2)).all()
        ]
        homes = furnished[: self.homes] or every
        few = replace(self.protocol.available(subject.predict.gives), viewpoint_sets=1)
        choices = few.choose(subject, homes, silent=True)
        for (approach, category), choice in choices.items():
            pl_module.log(f"global/{category}/{approach}/val", choice.iou, rank_zero_only=True)
        first_width = replace(few, cell_widths=self.protocol.cell_widths[:1])
        for example in first_width.measure(subject, homes, choices, silent=True).examples:
            add_image(trainer, f"maps/{example.category}/val", side_by_side(example))


def _data(trainer: Trainer) -> SceneData:
    data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
    return data
