"""Pictures of first-person segmentation in TensorBoard."""

from typing import Any, cast

import numpy as np
from jaxtyping import UInt8
from lightning import Callback, LightningModule, Trainer

from imagination.callbacks.unit_images import add_image, spread
from imagination.data.collate import Batch
from imagination.data.datamodule import SceneData
from imagination.evaluation.prediction import Segmenter
from imagination.utils.errors import check_range


class SegmentationImages(Callback):
    """Draws views of validation scenes, one row each: RGB, true segmentation, predicted segmentation.

    Args:
        views: drawn at each validation, spread over its first batch.
    """

    def __init__(self, views: int) -> None:
        self.views = int(check_range("segmentation_images.views", views, 1, 64))

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        *_: Any,
    ) -> None:
        if batch_idx > 0 or not trainer.is_global_zero:
            return
        data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
        chosen = spread(batch, self.views)
        rgb, truth = chosen["rgb"], chosen["segmentation"]
        predicted = cast(Segmenter, pl_module).segment(rgb, *truth.shape[-2:])
        colours = [row.colour for row in data.observer.categories if row.name in data.unit_categories]
        images = rgb.cpu().permute(0, 2, 3, 1).numpy()
        add_image(
            trainer,
            "views/val",
            draw(images, truth.cpu().numpy(), predicted.cpu().numpy(), np.array(colours)),
        )


def draw(
    rgb: UInt8[np.ndarray, "n h w 3"],
    truth: UInt8[np.ndarray, "n h w"],
    predicted: UInt8[np.ndarray, "n h w"],
    colours: np.ndarray,
) -> UInt8[np.ndarray, "height width 3"]:
    """One row for each view: image, truth, prediction.

    Args:
        rgb: images.
        truth, predicted: 0 for none, else the category's place + 1.
        colours: RGB of each category.
    """
    palette = np.concatenate([np.zeros((1, 3)), colours]).astype(np.uint8)
    panels = [rgb, palette[truth], palette[predicted]]
    framed = [np.pad(panel, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=128) for panel in panels]
    return np.concatenate(np.concatenate(framed, axis=2))
