"""Tasks as Lightning uses them: loading from a checkpoint and predicting with the data module."""

import subprocess
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from torch import Tensor

from imagination.config.compose import compose
from imagination.data.collate import ImageCollate
from imagination.geometry.grid import EgoGrid
from imagination.models.lit_task import LitTask
from imagination.models.lit_unit import LitUnit
from imagination.models.losses import WeightedBCE
from imagination.models.segmentation.lit_segmentation import LitSegmentation
from imagination.models.unit import Prediction, Unit
from imagination.runs.checkpoint import KEY, hyperparameters
from imagination.utils.errors import UserError
from tests.data.test_datamodule import data
from tests.helpers.checkpoints import make_checkpoint
from tests.helpers.scored import quiet_trainer

ADAM = partial(torch.optim.Adam, lr=0.001)
CONSTANT = partial(torch.optim.lr_scheduler.StepLR, step_size=1000)


class Occupied(Unit):
    """Unit that predicts the occupied cells."""

    def __init__(self) -> None:
        super().__init__(["bed"])
        self.scale = torch.nn.Parameter(torch.tensor(9.0))

    def logits(self, rgb: Tensor, depth: Tensor, occupied: Tensor, seen: Tensor) -> Tensor:
        return self.scale * (2 * occupied.float() - 1)


class Dark(torch.nn.Module):
    """Network that predicts its last class in dark pixels."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.layer = torch.nn.Conv2d(3, classes, 1)
        torch.nn.init.zeros_(self.layer.weight)
        self.layer.weight.data[0] = 1.0
        self.layer.bias.data[:] = torch.tensor([0.0, 200.0])

    def forward(self, rgb: Tensor) -> Tensor:
        return self.layer(rgb.float())


def unit() -> LitUnit:
    return LitUnit(Occupied(), WeightedBCE(), EgoGrid(0.12, 43), 0.62, ADAM, CONSTANT)


def segmentation_checkpoint(path: Path) -> Path:
    overrides = ["experiment=segmentation_hrnet", "scale=test"]
    config = compose("train", [*overrides, "paths.run=."])
    config.choices = overrides
    torch.manual_seed(0)
    state = instantiate(config.model.module).state_dict()
    torch.save({"state_dict": state, KEY: hyperparameters(config)}, path)
    return path


def test_a_unit_is_loaded_from_its_checkpoint(tmp_path: Path) -> None:
    path = make_checkpoint(tmp_path / "chair.ckpt", threshold=0.55)
    loaded = LitUnit.load_from_checkpoint(path)
    assert loaded.categories == ["chair"] and not loaded.training
    assert loaded.selected_thresholds.tolist() == pytest.approx([0.55])
    for name, value in torch.load(path, weights_only=True)["state_dict"].items():
        assert torch.equal(loaded.state_dict()[name], value), name
    assert type(LitTask.load_from_checkpoint(path)) is LitUnit  # whichever task it is
    with pytest.raises(UserError, match=r"got a LitUnit, expected a LitSegmentation"):
        LitSegmentation.load_from_checkpoint(path)


def test_a_segmentation_network_is_loaded_from_its_checkpoint(tmp_path: Path) -> None:
    loaded = LitSegmentation.load_from_checkpoint(segmentation_checkpoint(tmp_path / "hrnet.ckpt"))
    assert loaded.categories == ["chair", "bed", "table"] and not loaded.training
    assert loaded.segment(torch.zeros(1, 3, 48, 48, dtype=torch.uint8), 48, 48).shape == (1, 48, 48)


def test_loading_unpickles_nothing(tmp_path: Path) -> None:
    torch.save({"state_dict": {}, KEY: {"choices": [], "values": subprocess.Popen}}, tmp_path / "a.ckpt")
    with pytest.raises(UserError, match="cannot be read"):
        LitUnit.load_from_checkpoint(tmp_path / "a.ckpt")


@pytest.mark.slow
def test_a_unit_predicts_the_views_of_the_data_module(tmp_path: Path) -> None:
    module, views = unit(), data(tmp_path, workers=1)
    predictions = quiet_trainer().predict(module, datamodule=views)
    assert views._pool is None  # stopped by teardown
    batches = list(views.predict_dataloader())
    assert sum(len(batch["rgb"]) for batch in batches) == 4
    assert predictions is not None and len(predictions) == len(batches)
    for prediction, batch in zip(predictions, batches, strict=True):
        assert isinstance(prediction, Prediction)
        assert torch.equal(prediction.maps > 0.5, batch["occupied"] > 0)


def test_a_segmentation_network_predicts_one_scene(tmp_path: Path) -> None:
    views = data(tmp_path)
    views.collate = ImageCollate()
    module = LitSegmentation(Dark, ["bed"], ADAM, CONSTANT)
    loader = views.scene_dataloader("val_0", 5)
    predictions = quiet_trainer().predict(module, loader)
    assert predictions is not None
    images = torch.cat([batch["rgb"] for batch in loader])
    assert images.shape == (5, 3, 32, 32)
    assert torch.equal(torch.cat(predictions) == 1, images.float().sum(dim=1) < 200)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="scene: got 'attic'.*val_0"):
        views.scene_dataloader("attic", 5)


def test_hyperparameters_are_plain_values_under_lightnings_key(tmp_path: Path) -> None:
    module = unit()
    config = compose("train", ["experiment=chair_unet", "scale=test", "seed=5", "paths.run=."])
    config.choices = ["experiment=chair_unet", "scale=test", "seed=5"]
    module.save_hyperparameters(hyperparameters(config), logger=False)
    trainer = quiet_trainer(max_epochs=0)
    trainer.fit(module, data(tmp_path).val_dataloader())
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    saved = torch.load(tmp_path / "a.ckpt", weights_only=True)["hyper_parameters"]
    assert saved["values"]["seed"] == 5 and "_target_" not in str(saved)
