"""Images of validation views: which views are shown, what is drawn, and which loggers get them."""

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from matplotlib.figure import Figure

from imagination.callbacks import segmentation_images, unit_images
from imagination.callbacks.view_images import ViewImages, largest, to_image
from imagination.data.collate import Batch
from imagination.data.datamodule import SceneData
from imagination.models.lit_task import LitTask
from tests.runs.test_resume import points


def panels(figure: Figure) -> dict[str, Any]:
    """Return the images of the first row by title."""
    return {axis.get_title(): axis.images[0].get_array() for axis in figure.axes if axis.get_title()}


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_a_row_of_a_unit_has_titles_and_a_legend() -> None:
    views = {
        "rgb": np.full((2, 3, 8, 8), 200, np.uint8),
        "depth": np.full((2, 1, 8, 8), 3.0, np.float16),
        "occupied": np.zeros((2, 1, 9, 9), np.uint8),
        "seen": np.ones((2, 1, 9, 9), np.uint8),
        "label": np.zeros((2, 2, 9, 9), np.uint8),
    }
    views["label"][:, 1, 4, 4] = 1
    prediction = np.zeros((2, 2, 9, 9), np.float32)
    prediction[:, 1, 4, 4] = 1.0
    prediction[:, 1, 0, 0] = 0.4  # below the threshold and far from valid cells
    figure = unit_images.draw(views, prediction, ["chair", "bed"], valid_threshold=0.5, epsilon=3)
    shown = panels(figure)
    by_category = [
        f"{panel}, {name}" for name in ("chair", "bed") for panel in ("Label", "Prediction", "V_valid")
    ]
    assert list(shown) == ["Image", "Depth, 0 to 6 m", *by_category]
    assert tuple(shown["Label, bed"][4, 4]) == unit_images.GROUND_TRUTH
    assert tuple(shown["Label, chair"][4, 4]) == unit_images.SEEN
    assert (shown["Prediction, bed"][0, 0], shown["V_valid, bed"][0, 0]) == (np.float32(0.4), 0)
    assert shown["V_valid, bed"][4, 4] == 1
    assert legend(figure) == ["label", "occupied", "seen", "not seen"]
    image = to_image(figure)
    assert image.dtype == np.uint8 and image.shape[1] > 1000


def test_a_row_of_a_segmentation_has_the_colours_of_the_categories() -> None:
    views = {"rgb": np.zeros((1, 3, 4, 4), np.uint8), "segmentation": np.array([[[0, 1], [2, 0]]], np.uint8)}
    predicted = np.array([[[2, 1], [0, 0]]], np.uint8)
    figure = segmentation_images.draw(views, predicted, {"chair": (10, 20, 30), "bed": (40, 50, 60)})
    shown = panels(figure)
    assert list(shown) == ["Image", "Ground truth", "Prediction"]
    assert shown["Ground truth"].tolist() == [[[0, 0, 0], [10, 20, 30]], [[40, 50, 60], [0, 0, 0]]]
    assert tuple(shown["Prediction"][0, 0]) == (40, 50, 60)
    assert legend(figure) == ["background", "chair", "bed"]


def batch(*sizes: int) -> Batch:
    """Return a batch of views whose labels have these sizes; their images hold the sizes as well."""
    label = torch.zeros(len(sizes), 1, 3, 3, dtype=torch.uint8)
    for view, size in zip(label, sizes, strict=True):
        view.view(-1)[:size] = 1
    return {"rgb": torch.tensor(sizes)[:, None], "label": label}


def test_views_with_the_category_are_selected() -> None:
    views = batch(0, 3, 0, 7, 1)
    assert largest(views, "label", 2)["rgb"].flatten().tolist() == [7, 3]
    assert largest(views, "label", 9)["rgb"].flatten().tolist() == [7, 3, 1]


class Shown(ViewImages):
    """Callback that records the sizes of the labels that it would draw."""

    def draw(self, batch: Batch, task: LitTask, data: SceneData) -> Figure:
        self.sizes = batch["rgb"].flatten().tolist()
        return Figure(figsize=(1, 1))


def test_images_come_from_all_batches_and_follow_the_loggers(tmp_path: Path) -> None:
    class Weights(CSVLogger):
        """Logger with images, as that of Weights & Biases."""

        def log_image(self, key: str, images: list[np.ndarray], step: int) -> None:
            self.logged = key, len(images), step

    board, weights = TensorBoardLogger(tmp_path, "tensorboard", ""), Weights(str(tmp_path), "weights")
    trainer = Mock(
        spec=Trainer, is_global_zero=True, sanity_checking=False, testing=False, num_val_batches=[3],
        global_step=8, datamodule=None, loggers=[CSVLogger(str(tmp_path), "csv"), board, weights],
    )  # fmt: skip
    callback, module = Shown(4), Mock(spec=LightningModule, target="label")
    for _ in range(2):
        callback.on_validation_epoch_start(trainer, module)
        for index, views in enumerate((batch(0, 5, 2), batch(1, 0, 0), batch(9, 8, 0))):
            callback.on_validation_batch_end(trainer, module, None, views, index)
        callback.on_validation_epoch_end(trainer, module)
        assert callback.sizes == [9, 8, 5, 2]
    board.finalize("success")
    assert "views/val" in points(tmp_path / "tensorboard") and weights.logged == ("views/val", 1, 7)
