"""LightningModule of units: logging, training, and prediction without side effects."""

from functools import partial

import lightning
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from imagination.data.batches import parts
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.models.backbones import UNet
from imagination.models.encoders import TimmEncoder
from imagination.models.imagination_unit import ImaginationUnit
from imagination.models.lit_unit import LitUnit
from imagination.models.losses import BCEDice, WeightedBCE, imagination_loss
from imagination.models.projected_unit import ProjectedUnit
from imagination.models.unit import Unit
from imagination.utils.errors import UserError
from tests.helpers.batches import random_batch

EGO = EgoGrid(0.12, 17)
CAMERA = Camera.from_degrees(32, 32, 90.0, 1.25)


def training(kind: type = ImaginationUnit, **options: float) -> LitUnit:
    torch.manual_seed(0)
    parts = {
        "encoder": TimmEncoder("resnet18", 32, 32),
        "backbone": partial(UNet, width=4),
        "categories": ["chair"],
    }
    parts |= {"camera": CAMERA, "ego": EGO}
    if kind is ProjectedUnit:
        parts |= {"max_height": 1.5, "width": 4}
    else:
        parts |= {"heights": [0.2, 0.5, 1.5], "height_jitter": 0.0}
    schedule = partial(torch.optim.lr_scheduler.StepLR, step_size=1, gamma=0.1)
    loss = WeightedBCE()
    return LitUnit(kind(**parts), loss, EGO, 0.36, partial(torch.optim.Adam, lr=0.001), schedule, **options)


def loader(batches: int) -> DataLoader[dict[str, Tensor]]:
    views = [random_batch(2, 32, 17, seed=seed) for seed in range(batches)]
    return DataLoader(views, batch_size=None)


def test_a_short_run_logs_all_metrics() -> None:
    module = training()
    trainer = lightning.Trainer(
        max_epochs=2, accelerator="cpu", logger=False, enable_checkpointing=False, log_every_n_steps=1,
        enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
    )  # fmt: skip
    trainer.fit(module, loader(3), loader(2))
    metrics = trainer.callback_metrics
    for name in ("loss", "w_alpha", "w_gamma", "empty_labels"):
        assert metrics[f"train/{name}"].isfinite(), name
    assert trainer.optimizers[0].param_groups[0]["lr"] == pytest.approx(1e-5)  # stepped once an epoch
    trainer.test(module, loader(2), verbose=False)
    for stage, logged in (("val", metrics), ("test", trainer.callback_metrics)):
        for name in ("loss", "iou", "iou_seen", "iou_unseen", "precision", "recall"):
            assert f"{stage}/{name}" in logged


class PlainUnit(Unit):
    """Unit without batch normalisation, whose statistics would be those of a micro-batch."""

    def __init__(self) -> None:
        super().__init__(["chair"])
        self.layer = torch.nn.Conv2d(2, 1, 3, padding=1)

    def logits(self, rgb: Tensor, depth: Tensor, occupied: Tensor, seen: Tensor) -> Tensor:
        return self.layer(torch.cat([occupied, seen], dim=1).float())


def test_an_accumulated_batch_trains_as_a_whole_one() -> None:
    batches = [random_batch(6, 32, 17, seed=seed) for seed in range(3)]
    batches[0]["label"][1:] = 0
    weights = []
    for count in (1, 3):
        torch.manual_seed(0)
        module = training(ImaginationUnit)
        module.unit = PlainUnit()
        module.optimizer = partial(torch.optim.SGD, lr=0.01)  # Adam's steps do not scale with the gradient
        trainer = lightning.Trainer(
            max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
            enable_model_summary=False, accumulate_grad_batches=count,
        )  # fmt: skip
        trainer.fit(
            module,
            DataLoader(
                [part for batch in batches for part in parts(batch, count, module.batch_totals)],
                batch_size=None,
            ),
        )
        assert trainer.global_step == 3
        weights.append(module.unit.layer.weight.detach().clone())
    torch.testing.assert_close(*weights, rtol=1e-4, atol=1e-6)


class MicroBatches(lightning.LightningDataModule):
    """Data module that splits batches."""

    micro_batches = 2

    def train_dataloader(self) -> DataLoader:
        return loader(2)


def test_a_loss_that_needs_the_whole_batch_is_refused_with_micro_batches() -> None:
    module = training()
    module.loss = BCEDice()
    trainer = lightning.Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    with pytest.raises(UserError, match=r"data.micro_batches: got 2.*BCEDice"):
        trainer.fit(module, datamodule=MicroBatches())


@pytest.mark.parametrize("kind", [ImaginationUnit, pytest.param(ProjectedUnit, marks=pytest.mark.slow)])
def test_a_unit_can_overfit_one_batch(kind: type) -> None:
    module = training(kind)
    batch = random_batch(4, 32, 17)
    optimizer = torch.optim.Adam(module.parameters(), lr=0.01)
    for _ in range(120):
        loss, _ = imagination_loss(module(batch), batch["label"], batch["neighbourhood"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    predicted, gt = module(batch) > 0, batch["label"] > 0
    assert (predicted & gt).sum() / (predicted | gt).sum() > 0.9


def test_predict_gives_probabilities_and_leaves_the_module_as_it_was() -> None:
    module = training()
    before = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    batch = random_batch(2, 32, 17)
    (first, raw), (second, _) = module.predict(batch), module.predict(batch)
    assert module.training and not first.requires_grad and raw.shape == first.shape
    assert torch.equal(first, second) and first.shape == (2, 1, 17, 17)
    assert ((first >= 0) & (first <= 1)).all()
    assert all(torch.equal(tensor, before[name]) for name, tensor in module.state_dict().items())


def test_a_checkpoint_holds_weights_and_plain_values_only(tmp_path) -> None:
    module = training()
    trainer = lightning.Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module, loader(1))
    trainer.save_checkpoint(tmp_path / "unit.ckpt")
    state = torch.load(tmp_path / "unit.ckpt", weights_only=True)
    assert not state.get("hyper_parameters")
    module.load_state_dict(state["state_dict"])


@pytest.mark.parametrize("option", ["alpha_max", "gamma_max", "valid_threshold"])
def test_values_out_of_range_are_refused_by_name(option: str) -> None:
    for value in (-1.0, float("nan")):
        with pytest.raises(UserError, match=option):
            training(valid_threshold=value) if option == "valid_threshold" else WeightedBCE(**{option: value})
