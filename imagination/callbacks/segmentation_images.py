"""Images of first-person segmentation in TensorBoard."""

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
    """Callback that draws views of validation scenes, one row each: RGB, ground truth, predicted segmentation.

    Args:
        views: number of views drawn at each validation, evenly spaced in its first batch.

    Raises:
        UserError: if the number of views is out of range.
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
        selected = spread(batch, self.views)
        rgb, gt = selected["rgb"], selected["segmentation"]
        predicted = cast(Segmenter, pl_module).segment(rgb, *gt.shape[-2:])
        colours = [row.colour for row in data.observer.categories if row.name in data.unit_categories]
        images = rgb.cpu().permute(0, 2, 3, 1).numpy()
        add_image(
            trainer,
            "views/val",
            draw(images, gt.cpu().numpy(), predicted.cpu().numpy(), np.array(colours)),
        )


def draw(
    rgb: UInt8[np.ndarray, "n h w 3"],
    gt: UInt8[np.ndarray, "n h w"],
    predicted: UInt8[np.ndarray, "n h w"],
    colours: np.ndarray,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw one row for each view: image, ground truth, prediction.

    Args:
        rgb: camera images.
        gt, predicted: segmentations, 0 for background, else category index + 1.
        colours: RGB colour of each category.
    """
    palette = np.concatenate([np.zeros((1, 3)), colours]).astype(np.uint8)
    panels = [rgb, palette[gt], palette[predicted]]
    framed = [np.pad(panel, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=128) for panel in panels]
    return np.concatenate(np.concatenate(framed, axis=2))
