"""The evaluation's config: the checkpoint's run, changed by the command line."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from imagination.checkpoints import KEY, Checkpoint, ConfigInCheckpoint
from imagination.config import compose
from imagination.errors import UserError
from imagination.evaluate import configured


def checkpoint(choices: list[str], *values: str) -> Checkpoint:
    """What a run with these overrides keeps of its config, without weights."""
    config = compose("train", [*choices, *values, "paths.run=."])
    OmegaConf.update(config, "choices", [*choices, *values])
    return Checkpoint(Path("best.ckpt"), {KEY: ConfigInCheckpoint(config).description, "state_dict": {}})


@pytest.fixture(scope="module")
def chair() -> Checkpoint:
    return checkpoint(["scale=test"])


def node(config: DictConfig, key: str) -> Any:
    value = OmegaConf.select(config, key)
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


NODES = (
    "scale",
    "seed",
    "unit_categories",
    "kernels",
    "mapping",
    "evaluation",
    "data",
    "camera",
    "name",
    "categories",
)


def test_without_overrides_everything_is_as_in_the_run() -> None:
    choices = ["+experiment=bed_unet", "scale=test", "mapping/registration=mean"]
    values = ["seed=3", "scale.viewpoint_sets=2", "kernels.neighbourhood=0.8", "name=mine"]
    values += [
        "evaluation.cell_widths=[4.0]",
        "mapping.segmentation.max_range=3.5",
        "camera.width=40",
        "kernels.imaginable=0.9",
    ]  # in the place of references
    trained = compose("train", [*choices, *values, "paths.run=."])
    evaluated = configured([checkpoint(choices, *values)], ["ckpt=best.ckpt"])
    for key in NODES:
        assert node(evaluated, key) == node(trained, key), key


def test_an_override_reaches_everything_that_refers_to_it() -> None:
    kept = checkpoint(["scale=test"], "seed=3", "aggregation_factor=0.5", "scale.viewpoint_sets=2")
    changes = ["aggregation_factor=0.9", "scale.viewpoint_sets=1", "evaluation.cell_widths=[4]"]
    config = configured([kept], ["ckpt=best.ckpt", *changes])
    assert config.seed == 3
    assert config.mapping.registration.aggregation_factor == 0.9  # the default, although the run had another
    assert config.evaluation.viewpoint_sets == 1
    assert config.evaluation.cell_widths == [4]


def test_the_registration_rule_can_be_swept(chair: Checkpoint) -> None:
    config = configured([chair], ["ckpt=best.ckpt", "mapping/registration=overwrite"])
    assert config.evaluation.approaches.imagination.rule._target_.endswith("Overwrite")
    assert config.evaluation.approaches.seg_gt.rule._target_.endswith("Max")


def test_units_of_several_categories_stand_side_by_side(chair: Checkpoint) -> None:
    bed = checkpoint(["+experiment=bed_unet", "scale=test"])
    assert configured([bed, chair], ["ckpt=[a,b]"]).unit_categories == ["bed", "chair"]
    with pytest.raises(UserError, match="expected each category once"):
        configured([chair, chair], ["ckpt=[a,a]"])


@pytest.mark.parametrize("override", ["unit_categories=[chair,bed]", "scale.resolution=0.1"])
def test_a_checkpoint_of_something_else_is_refused(chair: Checkpoint, override: str) -> None:
    with pytest.raises(UserError, match=r"best\.ckpt: is of chair at 0\.12 m"):
        configured([chair], ["ckpt=best.ckpt", override])


@pytest.mark.parametrize("override", ["camera.width=40", "scale.ego_extent=4.2", "camera.mount_height=0.9"])
def test_another_camera_or_map_is_refused(chair: Checkpoint, override: str) -> None:
    with pytest.raises(UserError, match=r"best\.ckpt: was trained with the (camera|ego) "):
        configured([chair], ["ckpt=best.ckpt", override])


def test_nothing_but_plain_values_is_taken_from_a_checkpoint(chair: Checkpoint) -> None:
    for value in ("${oc.env:HOME}", "_target_"):
        strange = Checkpoint(chair.path, deepcopy(chair.state))
        strange.state[KEY]["values"]["name"] = value
        with pytest.raises(UserError, match="do not use this file"):
            configured([strange], ["ckpt=best.ckpt"])
