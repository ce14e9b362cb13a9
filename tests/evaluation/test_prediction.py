"""Several networks together: one unit predicts each category."""

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from imagination.evaluation.prediction import Predictor
from imagination.models.task_kind import TaskKind
from imagination.models.unit import Prediction
from imagination.utils.errors import UserError

TABLE = ["chair", "bed", "table"]


class Constant(nn.Module):
    """Unit that predicts a constant for each category, plus the brightness of the image."""

    kind = TaskKind.MAPS

    def __init__(self, **values: float) -> None:
        super().__init__()
        self.categories = list(values)
        self.values = nn.Parameter(torch.tensor(list(values.values())))

    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        bright = batch["rgb"].float().mean(dim=(1, 2, 3)) / 1000
        maps = (self.values + bright[:, None])[..., None, None].expand(-1, -1, 5, 5).detach()
        return Prediction(maps, maps / 2)


class Painter(nn.Module):
    """Segmentation network that predicts its last category everywhere."""

    kind = TaskKind.IMAGES

    def __init__(self, *categories: str) -> None:
        super().__init__()
        self.categories = list(categories)

    def segment(self, rgb: Tensor, rows: int, columns: int) -> Tensor:
        return torch.full((len(rgb), rows, columns), len(self.categories), dtype=torch.uint8)


def views(count: int) -> dict[str, np.ndarray]:
    return {
        "pose": np.zeros((count, 3)),
        "rgb": np.arange(count, dtype=np.uint8)[:, None, None, None] * np.ones((1, 4, 4, 3), np.uint8),
        "depth": np.zeros((count, 4, 4), np.float16),
        "occupied": np.zeros((count, 5, 5), bool),
        "seen": np.zeros((count, 5, 5), bool),
    }


def test_each_category_comes_from_the_unit_that_has_it() -> None:
    predictor = Predictor([Constant(table=0.3), Constant(bed=0.1, chair=0.2)], ["chair", "table"], TABLE, 2)
    assert predictor.gives == {"maps", "raw_maps", "maps_of_shuffled_rgb"}
    maps = predictor(views(3), {"maps"})["maps"]
    both = predictor(views(3), {"maps", "raw_maps"})
    assert (both["maps"] == maps).all() and (both["raw_maps"] == maps / 2).all()
    assert predictor(views(3), {"raw_maps"}).keys() == {"raw_maps"}
    assert maps.shape == (3, 2, 5, 5)
    assert maps[:, :, 0, 0] == pytest.approx(np.array([[0.2, 0.3]]) + np.arange(3)[:, None] / 1000)


@pytest.mark.parametrize("gpu", [False, True])
def test_networks_predict_in_the_requested_precision(gpu: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    # the device of the network decides, not the availability of a GPU
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)

    class Sum(nn.Module):
        kind = TaskKind.MAPS
        categories = ("chair",)

        def predict(self, batch: dict[str, Tensor]) -> Prediction:
            ones = torch.ones(1, 1)
            self.kind = (ones @ ones).dtype
            return Prediction(*(torch.zeros(len(batch["rgb"]), 1, 5, 5) for _ in range(2)))

    for precision, kind in (
        ("32-true", torch.float32),
        ("bf16-mixed", torch.bfloat16),
        ("16-mixed", torch.bfloat16),
    ):
        unit = Sum()
        Predictor([unit], ["chair"], TABLE, 2, precision)(views(1), {"maps"})
        assert unit.kind == kind


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_shuffling_gives_every_view_the_colours_of_another(count: int) -> None:
    predictor = Predictor([Constant(chair=0.0)], ["chair"], TABLE, 2)
    predictions = predictor(views(count), {"maps", "maps_of_shuffled_rgb"})
    own, others = (1000 * predictions[name][:, 0, 0, 0] for name in ("maps", "maps_of_shuffled_rgb"))
    assert sorted(others.round()) == sorted(own.round()) == list(range(count))
    assert count == 1 or (own.round() != others.round()).all()


def test_a_segmentation_s_classes_become_rows_of_the_table() -> None:
    predictor = Predictor([Painter("lamp", "table", "bed"), Constant(bed=0.0)], ["bed"], TABLE, 2)
    assert predictor.gives == {"maps", "raw_maps", "maps_of_shuffled_rgb", "images"}
    images = predictor(views(3), {"images"})["images"]
    assert images.shape == (3, 4, 4) and (images == 2).all()  # its third class, the table's second row
    assert (Predictor([Painter("bed", "lamp")], ["bed"], TABLE, 2)(views(1), {"images"})["images"] == 0).all()


def test_networks_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(UserError, match="'chair': got 2 units"):
        Predictor([Constant(chair=0.0), Constant(chair=0.0)], ["chair"], TABLE, 2)
    with pytest.raises(UserError, match="'bed': got 0 units"):
        Predictor([Constant(chair=0.0)], ["bed"], TABLE, 2)
    with pytest.raises(UserError, match="'bed': .*segmentation network"):
        Predictor([Painter("chair")], ["bed"], TABLE, 2)
    with pytest.raises(UserError, match="got 2 segmentation networks"):
        Predictor([Painter("chair"), Painter("chair")], ["chair"], TABLE, 2)


def test_the_fingerprint_follows_weights_and_precision() -> None:
    kinds = [(0.1, "32-true"), (0.2, "32-true"), (0.1, "32-true"), (0.1, "bf16-mixed")]
    prints = {
        Predictor([Constant(chair=value)], ["chair"], TABLE, 2, precision).fingerprint
        for value, precision in kinds
    }
    assert len(prints) == 3
    unit = Constant(chair=0.1)  # the settings of its predictions are no weights
    for settings in (
        {"postprocess_dilation": 3},
        {"postprocess_dilation": 1},
        {"tta_hflip": True, "postprocess_dilation": 1},
    ):
        vars(unit).update(settings)
        prints.add(Predictor([unit], ["chair"], TABLE, 2).fingerprint)
    assert len(prints) == 6
