"""Encoders: selection of the features of a timm model, and errors on bad names."""

import pytest
import timm
import torch

from imagination.models.encoders import TimmEncoder, early_stages
from imagination.utils.errors import UserError


def test_resnet18_gives_its_first_two_stages_at_an_eighth() -> None:
    encoder = TimmEncoder("resnet18", 64, 96)
    features = encoder(torch.zeros(2, 3, 64, 96, dtype=torch.uint8))
    assert features.shape == (2, 192, 8, 12)
    assert encoder.channels == 192
    assert not any("layer3" in name or "layer4" in name for name, _ in encoder.named_parameters())


def test_images_are_normalised_with_the_model_s_own_constants() -> None:
    encoder = TimmEncoder("resnet18", 32, 32).eval()
    rgb = torch.randint(0, 256, (2, 3, 32, 32), dtype=torch.uint8)
    mean, deviation = (
        (torch.tensor(row).view(3, 1, 1)) for row in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    )
    with torch.no_grad():
        early, late = encoder.model((rgb.float() / 255 - mean) / deviation)
        expected = torch.cat([torch.nn.functional.avg_pool2d(early, 2), late], dim=1)
        torch.testing.assert_close(encoder(rgb), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("strides", "stages"),
    [([2, 4, 8, 16, 32], [1, 2]), ([4, 8, 16, 32], [0, 1]), ([16, 16, 16], [2]), ([16, 32], [0])],
)
def test_early_stages(strides: list[int], stages: list[int]) -> None:
    assert early_stages(strides) == stages


def test_features_of_channels_last_models_are_permuted() -> None:
    encoder = TimmEncoder("swin_tiny_patch4_window7_224", 64, 64)
    assert encoder(torch.zeros(1, 3, 64, 64, dtype=torch.uint8)).shape == (1, 96 + 192, 8, 8)


@pytest.mark.parametrize(
    ("name", "close"), [("resnet81", "resnet18"), ("resnet18.a1_in2k", "resnet18.a1_in1k")]
)
def test_an_unknown_name_is_refused_with_close_ones(name: str, close: str) -> None:
    with pytest.raises(UserError, match=f"'{name}'.*{close}"):
        TimmEncoder(name, 32, 32)


def test_a_size_that_the_model_cannot_take_is_refused_by_name() -> None:
    with pytest.raises(UserError, match="'hrnet_w18_small'.* 50 x 70 pixels"):
        TimmEncoder("hrnet_w18_small", 50, 70)
    with pytest.raises(UserError, match=r"'xcit_nano_12_p16_224', img_size=\(50, 70\)"):
        TimmEncoder("xcit_nano_12_p16_224", 50, 70)


def test_a_model_of_a_fixed_size_is_created_with_the_camera_s() -> None:
    encoder = TimmEncoder("deit_tiny_patch16_224", 48, 64)
    assert encoder(torch.zeros(1, 3, 48, 64, dtype=torch.uint8)).shape == (1, 192, 3, 4)


def test_unused_stages_are_frozen() -> None:
    encoder = TimmEncoder("mobilenetv3_small_050", 64, 64)
    encoder(torch.zeros(2, 3, 64, 64, dtype=torch.uint8)).sum().backward()
    assert all((weight.grad is not None) == weight.requires_grad for weight in encoder.parameters())
    assert not all(weight.requires_grad for weight in encoder.parameters())


def test_weights_that_cannot_be_loaded_are_reported_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(name: str, pretrained: bool, **options: object) -> torch.nn.Module:
        if pretrained:
            raise OSError("no route to host")
        return create_model(name, pretrained=False, **options)

    create_model = timm.create_model
    monkeypatch.setattr(timm, "create_model", offline)
    with pytest.raises(
        UserError, match="model.encoder.name: got 'resnet18'.*no route to host.*pretrained=false"
    ):
        TimmEncoder("resnet18", 32, 32, pretrained=True)
