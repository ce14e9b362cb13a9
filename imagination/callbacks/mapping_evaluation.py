"""Mapping evaluation as a callback: on a few validation scenes during training and on all test scenes at the end."""

from dataclasses import replace
from pathlib import Path
from typing import cast

from lightning import Callback, LightningModule, Trainer

from imagination.callbacks.view_images import add_image, to_image
from imagination.data.datamodule import SceneData
from imagination.evaluation.protocol import MappingProtocol, ModelUnderTest
from imagination.evaluation.records import Example
from imagination.evaluation.run import evaluate, model_under_test
from imagination.models.lit_task import LitTask
from imagination.reporting import style
from imagination.reporting.figures.maps import draw_maps
from imagination.reporting.results_folder import write_results
from imagination.utils.errors import check_range
from imagination.utils.timing import stage


class MappingEvaluation(Callback):
    """Callback that logs the global IoU of each approach and writes tables and figures after the test.

    During training, thresholds are selected and evaluated on the same few validation scenes, with one viewpoint set
    each. These scores are slightly too high and only monitor training.

    Args:
        protocol: protocol of the evaluation.
        every_n_epochs: number of epochs between evaluations during training.
        scenes: number of validation scenes in an evaluation during training.
        folder: run folder, in which tables/ and figures/ are written.

    Raises:
        UserError: if a value is out of range.
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
        predictor = self._model_under_test(trainer, pl_module).predict
        self.protocol.available(predictor.gives)  # checked before training instead of after it

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if (trainer.current_epoch + 1) % self.every_n_epochs == 0 and trainer.is_global_zero:
            with stage("evaluation"):
                self._monitor(trainer, pl_module)

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        evaluation = evaluate(self.protocol, _data(trainer), [cast(LitTask, pl_module)], self.folder)
        for row in write_results(self.folder):
            tag = f"global/{row['category']}/{row['approach']}/{row['cell_width']}m"
            pl_module.log(tag, float(row["iou_pooled"]), rank_zero_only=True)
        for example in evaluation.report.examples:
            _add_maps(trainer, f"maps/{example.category}/{example.trial.cell_width:g}m", example)

    def _model_under_test(self, trainer: Trainer, pl_module: LightningModule) -> ModelUnderTest:
        """Return the network with its current weights, whose results are not cached."""
        return model_under_test(
            _data(trainer), [cast(LitTask, pl_module)], self.protocol.precision, keep=False
        )

    def _monitor(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data = _data(trainer)
        model = self._model_under_test(trainer, pl_module)
        names = data.observer.source.scenes("val")
        with_all_categories = [
            name
            for name in names
            if data.observer.ground_truth(name).truth[data.layers].any(axis=(1, 2)).all()
        ]
        scenes = with_all_categories[: self.scenes] or names
        protocol = replace(self.protocol.available(model.predict.gives), viewpoint_sets=1)
        thresholds = protocol.select_thresholds(model, scenes, silent=True)
        for (approach, category), threshold in thresholds.items():
            pl_module.log(f"global/{category}/{approach}/val", threshold.iou, rank_zero_only=True)
        first_width = replace(protocol, cell_widths=self.protocol.cell_widths[:1])
        for example in first_width.evaluate(model, scenes, thresholds, silent=True).examples:
            _add_maps(trainer, f"maps/{example.category}/val", example)


def _add_maps(trainer: Trainer, tag: str, example: Example) -> None:
    """Add the maps of a trial to the loggers."""
    if trainer.loggers:
        with style.theme("light"):
            add_image(trainer, tag, to_image(draw_maps([example])))


def _data(trainer: Trainer) -> SceneData:
    data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
    return data
