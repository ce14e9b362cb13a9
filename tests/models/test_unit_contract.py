"""Contract of units, for every unit, backbone and encoder of the configuration."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import nn

from imagination.models.losses import WeightedBCE
from tests.helpers.batches import inputs, random_batch

CONF = Path(__file__).parents[2] / "conf"
VARIANTS = sorted({path.stem for path in (CONF / "model").glob("*.yaml")} - {"training", "hrnet"})
BACKBONES = sorted(path.stem for path in (CONF / "model" / "backbone").glob("*.yaml"))
ENCODERS = {
    "resnet18": ["model/encoder=resnet18"],
    "convnext": ["model/encoder=timm", "model.encoder.name=convnext_atto"],
    "fixed size": ["model/encoder=timm", "model.encoder.name=deit_tiny_patch16_224"],
}


def build(*overrides: str) -> nn.Module:
    """Build a unit from the configuration, at the scale of the tests."""
    torch.manual_seed(0)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("train", ["scale=test", *overrides])
    return instantiate(config.model.unit)


def batch_for(**sizes: int) -> dict[str, torch.Tensor]:
    return random_batch(**({"size": 48, "cells": 31} | sizes))


def combinations() -> Iterator[Any]:
    """Every unit, backbone and encoder once with the default of the others; all combinations are slow."""
    default = "unit", "unet", "resnet18"
    for combination in product(VARIANTS, BACKBONES, ENCODERS):
        differences = sum(part != usual for part, usual in zip(combination, default, strict=True))
        yield pytest.param(*combination, marks=[pytest.mark.slow] if differences > 1 else [])


@pytest.mark.parametrize(("variant", "backbone", "encoder"), combinations())
def test_unit_fulfils_its_contract(variant: str, backbone: str, encoder: str) -> None:
    unit = build(f"model={variant}", f"model/backbone={backbone}", *ENCODERS[encoder])
    batch = batch_for()
    optimizer = torch.optim.SGD(unit.parameters(), lr=0.01)
    for _ in range(2):  # timm starts residual branches at zero: their gradients begin at the second step
        optimizer.zero_grad()
        unit(*inputs(batch)).square().mean().backward()
        optimizer.step()
    without = [
        name for name, weight in unit.named_parameters() if weight.grad is None or not weight.grad.any()
    ]
    assert not without, f"no gradient reaches {without}"

    unit.eval()
    with torch.no_grad():
        logits, again = unit(*inputs(batch)), unit(*inputs(batch))
        alone = unit(*(tensor[1:] for tensor in inputs(batch)))
    assert logits.shape == batch["label"].shape and logits.dtype == torch.float32 and logits.isfinite().all()
    assert torch.equal(logits, again), "evaluation is not deterministic"
    torch.testing.assert_close(logits[1:], alone, rtol=1e-4, atol=1e-4)  # views are independent


@pytest.mark.parametrize("variant", VARIANTS)
def test_tta_hflip_is_the_mean_over_both_flips(variant: str) -> None:
    augmented, plain = (
        build(
            f"model={variant}",
            f"model.tta_hflip={tta_hflip}",
            "model.height_jitter=0",
            "model.postprocess_dilation=0",
        )
        for tta_hflip in ("true", "false")
    )
    views = inputs(batch_for())
    with torch.no_grad():
        assert torch.equal(augmented(*views), plain(*views))  # no augmentation in training
        augmented.eval(), plain.eval()
        straight, mirrored = plain(*views), plain(*(view.flip(-1) for view in views)).flip(-1)
        torch.testing.assert_close(augmented(*views), (straight + mirrored) / 2, rtol=1e-4, atol=1e-4)
        with torch.autocast("cpu", torch.bfloat16):
            assert augmented(*views).isfinite().all()
    assert (straight - mirrored).abs().max() > 0.01


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("window", "cells"), [(0.0, 1), (0.5, 5)])
def test_postprocess_dilation_equals_opencv(variant: str, window: float, cells: int) -> None:
    raw, postprocessed = (
        build(
            f"model={variant}",
            f"model.postprocess_dilation={size}",
            "model.height_jitter=0",
            "model.tta_hflip=false",
        )
        for size in (0.0, window)
    )
    views, square = inputs(batch_for()), np.ones((cells, cells))
    with torch.no_grad():
        assert torch.equal(raw(*views), postprocessed(*views))  # no postprocessing in training
        thin, thick = (unit.eval()(*views)[:, 0].numpy() for unit in (raw, postprocessed))
        np.testing.assert_array_equal(postprocessed.raw(*views)[:, 0].numpy(), thin)
    for before, after in zip(thin, thick, strict=True):
        sums, counts = (
            cv2.boxFilter(each, -1, square.shape, normalize=False, borderType=cv2.BORDER_CONSTANT)
            for each in (before, np.ones_like(before))
        )
        np.testing.assert_allclose(after, cv2.dilate(sums / counts, square), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("cells", [9, 33, 87, 261])
@pytest.mark.parametrize("backbone", BACKBONES)
def test_grids_of_any_size_work(backbone: str, cells: int) -> None:
    unit = build("model=unit", f"model/backbone={backbone}", f"ego.extent={0.12 * cells}").eval()
    batch = batch_for(cells=cells, views=1)
    with torch.no_grad():
        assert unit(*inputs(batch)).shape == (1, 1, cells, cells)


@pytest.mark.parametrize("variant", VARIANTS)
def test_images_need_not_be_square_and_categories_may_share_a_unit(variant: str) -> None:
    unit = build(f"model={variant}", "camera.height=40", "unit_categories=[chair,bed,table]").eval()
    with torch.no_grad():
        assert unit(*inputs(batch_for(height=40))).shape == (2, 3, 31, 31)


@pytest.mark.parametrize("variant", VARIANTS)
def test_an_untrained_unit_imagines_little(variant: str) -> None:
    unit = build(f"model={variant}")
    with torch.no_grad():
        assert unit(*inputs(batch_for(views=4))).sigmoid().mean() < 0.25


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_input_affects_the_prediction(variant: str) -> None:
    unit = build(f"model={variant}").eval()
    for name in ("rgb", "occupied", "seen"):
        batch = batch_for()
        changed = batch | {name: 1 - batch[name]}
        with torch.no_grad():
            assert not torch.equal(unit(*inputs(batch)), unit(*inputs(changed))), name


def test_units_of_a_module_get_the_gradients_of_training_alone() -> None:
    names = ["chair", "bed", "table"]
    exact = "model.height_jitter=0"  # random jitter would differ
    module = build("model=units", f"unit_categories=[{','.join(names)}]", exact)
    batch = random_batch(size=48, cells=31, categories=3)
    WeightedBCE()(module(*inputs(batch)), batch["label"], batch["neighbourhood"]).loss.backward()
    for index, (name, unit) in enumerate(zip(names, module.units, strict=True)):
        alone = build("model=unit", f"unit_categories=[{name}]", exact)
        part = batch["label"][:, [index]], batch["neighbourhood"][:, [index]]
        WeightedBCE()(alone(*inputs(batch)), *part).loss.backward()
        for ours, expected in zip(unit.parameters(), alone.parameters(), strict=True):
            torch.testing.assert_close(ours.grad, expected.grad)
