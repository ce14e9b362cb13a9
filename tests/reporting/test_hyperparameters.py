"""Hyperparameters and final scores for loggers."""

import pytest

from imagination.config.compose import compose
from imagination.reporting.hyperparameters import final_scores, logged_hyperparameters

JOB = ["experiment=chair_unet", "scale=test"]


@pytest.mark.parametrize(
    ("key", "choices"),
    [
        ("model.backbone", {"model/backbone=unet": "UNet", "model/backbone=fpn": "FPN"}),
        ("model.unit", {"model=unit": "ImaginationUnit", "model=projected": "ProjectedUnit"}),
        ("mapping.registration", {"mapping/registration=mean": "Mean", "mapping/registration=max": "Max"}),
        ("model.encoder.name", {"model.encoder.name=resnet18": "resnet18", "model.encoder.name=a": "a"}),
    ],
)
def test_hyperparameters_name_classes(key: str, choices: dict[str, str]) -> None:
    shown = {
        choice: logged_hyperparameters(compose("train", [*JOB, choice, "paths.run=."]))[key]
        for choice in choices
    }
    assert shown == choices


def test_what_was_chosen_is_shown_with_a_dozen_others() -> None:
    config = compose("train", [*JOB, "paths.run=."])
    config.choices = [*JOB, "model/encoder=resnet18", "model.loss.alpha_max=12.5", "kernels.imaginable=0.8"]
    shown = logged_hyperparameters(config)
    assert (shown["model.loss.alpha_max"], shown["kernels.imaginable"]) == (config.model.loss.alpha_max, 1.0)
    assert (shown["experiment"], shown["scale"], shown["model/encoder"]) == ("chair_unet", "test", "resnet18")
    assert (shown["name"], shown["unit_categories"]) == ("chair_unet", "['chair']")
    assert len(shown) < 20


def test_the_final_scores_are_those_of_the_approach_that_was_trained() -> None:
    metrics = {
        "test/iou": 0.5, "test/iou_seen": 0.6, "val/iou": 0.4, "global/chair/imagination/3m": 0.3,
        "global/chair/imagination/val": 0.2, "global/chair/seg_gt/3m": 0.9, "train/loss": 1.0,
    }  # fmt: skip
    approaches = ["seg_gt", "seg_hrnet", "imagination", "oracle"]
    assert final_scores(metrics, approaches) == {"test/iou": 0.5, "global/chair/imagination/3m": 0.3}
    segmentation = {"test/iou": 0.5, "global/bed/seg_gt/3m": 0.9, "global/bed/seg_hrnet/3m": 0.7}
    assert final_scores(segmentation, approaches) == {"test/iou": 0.5, "global/bed/seg_hrnet/3m": 0.7}
