"""The mapping task as a callback: a few validation scenes while training, all test scenes at its end."""

from dataclasses import replace
from pathlib import Path
from typing import cast

from lightning import Callback, LightningModule, Trainer

from imagination.callbacks.unit_images import add_image
from imagination.data.datamodule import SceneData
from imagination.evaluation.prediction import Model, Segmenter
from imagination.evaluation.protocol import MappingProtocol, ModelUnderTest
from imagination.evaluation.run import evaluate, model_under_test
from imagination.reporting.figures.maps import side_by_side
from imagination.reporting.results_folder import write_results
from imagination.utils.errors import check_range
from imagination.utils.timing import stage

Network = Model | Segmenter


class MappingEvaluation(Callback):
    """Logs the global IoU of each approach; writes tables and figures once the test is done.

    While training, the same few validation scenes serve to choose thresholds and to measure, with one viewpoint set
    each: these figures are a little too high, and only show how training goes.

    Args:
        protocol: of the evaluation.
        every_n_epochs: epochs between evaluations during training.
        scenes: validation scenes of each of these.
        folder: of the run; tables/ and figures/ are made in it.
    """

    def __init__(
        self, protocol: MappingProtocol, every_n_epochs: int, scenes: int, folder: str | Path
    ) -> None:
        self.protocol = protocol
        self.every_n_epochs = int(
            check_range("mapping_evaluation.every_n_epochs", every_n_epochs, 1, 1_000_000)
        )
        self.scenes = int(check_range("mapping_evaluation.scenes", scenes, 1, 100_000))
        self.folder = Path(folder)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        networks = self._subject(trainer, pl_module).predict
        self.protocol.available(networks.gives)  # refused before training, not after it

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if (trainer.current_epoch + 1) % self.every_n_epochs == 0 and trainer.is_global_zero:
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
            add_image(
                trainer, f"maps/{example.category}/{example.trial.cell_width:g}m", side_by_side(example)
            )

    def _subject(self, trainer: Trainer, pl_module: LightningModule) -> ModelUnderTest:
        """The network with its weights of this moment: what is found with them is not kept."""
        return model_under_test(
            _data(trainer), [cast(Network, pl_module)], self.protocol.precision, keep=False
        )

    def _monitor(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data = _data(trainer)
        subject = self._subject(trainer, pl_module)
        every = data.observer.source.scenes("val")
        furnished = [
            scene for scene in every if data.observer.truth(scene).truth[data.layers].any(axis=(1, 2)).all()
        ]
        scenes = furnished[: self.scenes] or every
        few = replace(self.protocol.available(subject.predict.gives), viewpoint_sets=1)
        choices = few.select_thresholds(subject, scenes, silent=True)
        for (approach, category), choice in choices.items():
            pl_module.log(f"global/{category}/{approach}/val", choice.iou, rank_zero_only=True)
        first_width = replace(few, cell_widths=self.protocol.cell_widths[:1])
        for example in first_width.evaluate(subject, scenes, choices, silent=True).examples:
            add_image(trainer, f"maps/{example.category}/val", side_by_side(example))


def _data(trainer: Trainer) -> SceneData:
    data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
    return data
