"""HRNetV2 and its LightningModule: shapes, gradients, training and logging."""

from functools import partial

import lightning
import pytest
import timm
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from imagination.data.batches import parts
from imagination.models.segmentation.hrnet import HRNetV2
from imagination.models.segmentation.lit_segmentation import LitSegmentation
from imagination.utils.errors import UserError

NAME = "hrnet_w18_small"

HALVED = partial(torch.optim.lr_scheduler.StepLR, step_size=1, gamma=0.5)  # once an epoch


def module(**options: float) -> LitSegmentation:
    torch.manual_seed(0)
    network = partial(HRNetV2, NAME, **options)
    return LitSegmentation(network, ["chair", "bed"], partial(torch.optim.Adam, lr=0.003), HALVED)


def batch(views: int = 2, seed: int = 0) -> dict[str, Tensor]:
    """Return a batch in which chairs are red and beds are green."""
    generator = torch.Generator().manual_seed(seed)
    gt = (
        torch.randint(0, 3, (views, 4, 4), generator=generator)
        .repeat_interleave(8, 1)
        .repeat_interleave(8, 2)
    )
    rgb = 200 * torch.stack([gt == 1, gt == 2, gt == 3], dim=1).to(torch.uint8)
    return {"rgb": rgb, "segmentation": gt.to(torch.uint8)}


def test_all_four_resolutions_reach_the_head() -> None:
    network = HRNetV2(NAME, 5).eval()
    image = torch.zeros(1, 3, 64, 96, dtype=torch.uint8)
    maps = network.encoder(image.float())
    assert [tuple(one.shape) for one in maps] == [
        (1, 16, 16, 24),
        (1, 32, 8, 12),
        (1, 64, 4, 6),
        (1, 128, 2, 3),
    ]
    assert network.decoder[0][0].in_channels == 16 + 32 + 64 + 128
    assert network(image).shape == (1, 5, 16, 24)
    network(image).sum().backward()
    assert all(weight.grad is not None for weight in network.parameters())


def test_branches_are_fused_bilinearly() -> None:
    """The reference uses nn.Upsample in bilinear mode, since timm's networks use nearest-neighbour interpolation."""
    network, reference = (
        HRNetV2(NAME, 5).eval().encoder,
        timm.create_model(NAME, features_only=True, feature_location="", out_indices=(1, 2, 3, 4)).eval(),
    )
    reference.load_state_dict(network.state_dict())
    reference.to(memory_format=torch.channels_last)
    for part in reference.modules():
        if isinstance(part, nn.Upsample):
            part.mode, part.align_corners = "bilinear", False
    image = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        for actual, expected in zip(network(image), reference(image), strict=True):
            torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize(
    ("size", "enlarge", "expected"), [((48, 40), 1.0, (16, 16)), ((48, 40), 2.0, (24, 24))]
)
def test_images_of_any_size_work(size: tuple[int, int], enlarge: float, expected: tuple[int, int]) -> None:
    network = HRNetV2(NAME, 3, enlarge).eval()
    with torch.no_grad():
        assert network(torch.zeros(1, 3, *size, dtype=torch.uint8)).shape == (1, 3, *expected)


@pytest.mark.slow
def test_a_network_can_overfit_one_batch_and_segmenting_has_no_side_effects() -> None:
    trained, views = module(), batch()
    optimizer = trained.configure_optimizers()["optimizer"]
    for _ in range(60):
        loss, _ = trained.compare(views)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    before = {name: value.clone() for name, value in trained.state_dict().items()}
    predicted = trained.segment(views["rgb"], 32, 32)
    assert (predicted == views["segmentation"]).float().mean() > 0.9
    assert trained.segment(views["rgb"], 16, 64).shape == (2, 16, 64)  # the size of the depth image
    assert trained.training and all(
        torch.equal(value, before[name]) for name, value in trained.state_dict().items()
    )


def test_tta_hflip_is_the_mean_over_both_flips() -> None:
    trained, views = module(), batch()["rgb"]
    trained(views), trained.eval()
    with torch.no_grad():
        straight, mirrored = trained(views), trained(views.flip(-1)).flip(-1)
        trained.tta_hflip = True
        torch.testing.assert_close(trained(views), (straight + mirrored) / 2)
        torch.testing.assert_close(trained(views.flip(-1)).flip(-1), trained(views))
    assert (straight - mirrored).abs().max() > 0.01


def test_scores_are_those_of_the_pixels() -> None:
    trainer = lightning.Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, num_sanity_val_steps=0,
    )  # fmt: skip
    trained = module()
    views = DataLoader([batch(2, 1), batch(3, 2)], batch_size=None)
    trainer.fit(trained, views, views)
    logged = {name: float(value) for name, value in trainer.callback_metrics.items()}
    trained.eval()
    pairs = [(trained.segment(one["rgb"], 32, 32), one["segmentation"]) for one in (batch(2, 1), batch(3, 2))]
    ious = []
    for index, name in ((1, "chair"), (2, "bed")):
        intersection = sum(int(((predicted == index) & (gt == index)).sum()) for predicted, gt in pairs)
        union = sum(int(((predicted == index) | (gt == index)).sum()) for predicted, gt in pairs)
        ious.append(intersection / union)
        assert logged[f"val/iou_{name}"] == pytest.approx(ious[-1], abs=1e-6)
    assert logged["val/iou"] == pytest.approx(sum(ious) / 2, abs=1e-6)
    assert {"train/loss", "val/precision_bed", "val/recall_chair"} <= set(logged)


def test_an_accumulated_batch_trains_as_a_whole_one() -> None:
    weights = []
    for count in (1, 3):  # 7 views: parts of 3, 2 and 2
        torch.manual_seed(0)
        trained = LitSegmentation(Pixels, ["chair", "bed"], partial(torch.optim.SGD, lr=0.01), HALVED)
        trainer = lightning.Trainer(
            max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
            enable_model_summary=False, accumulate_grad_batches=count,
        )  # fmt: skip
        split = [part for seed in range(3) for part in parts(batch(7, seed), count, trained.batch_totals)]
        trainer.fit(trained, DataLoader(split, batch_size=None))
        assert trainer.global_step == 3
        weights.append(trained.network.layer.weight.detach().clone())
    torch.testing.assert_close(*weights)


class Pixels(nn.Module):
    """Network without batch normalisation, whose statistics would be those of a micro-batch."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.layer = nn.Conv2d(3, classes, 1)

    def forward(self, rgb: Tensor) -> Tensor:
        return self.layer(rgb / 255)


def test_an_unknown_network_of_timm_is_refused() -> None:
    with pytest.raises(
        UserError, match=r"model\.network\.name: got 'hrnet_w17', expected one of: .*hrnet_w48"
    ):
        HRNetV2("hrnet_w17", 3)
