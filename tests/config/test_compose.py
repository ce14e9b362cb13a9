"""Each experiment composes at each scale, the sizes of the scale apply, and invalid values are refused by name."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hydra.errors import HydraException
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.config.validation import validate
from imagination.data.replay_buffer import ReplayBuffer
from imagination.utils.errors import UserError
from imagination.utils.precision import resolved
from tests.conftest import ROOT

CONF = ROOT / "conf"


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def read(path: Path) -> dict:
    return yaml.safe_load(path.read_text())


@pytest.mark.parametrize("scale", options("scale"))
@pytest.mark.parametrize("experiment", options("experiment"))
def test_the_scale_sets_all_sizes(experiment: str, scale: str) -> None:
    check_sizes(experiment, scale, [])


@pytest.mark.parametrize("callbacks", options("callbacks"))
def test_the_scale_sets_all_sizes_with_any_callbacks(callbacks: str) -> None:
    check_sizes("chair_unet", "test", [f"callbacks=[{callbacks}]"])


@pytest.mark.slow
@pytest.mark.parametrize("callbacks", options("callbacks"))
@pytest.mark.parametrize("scale", options("scale"))
@pytest.mark.parametrize("experiment", options("experiment"))
def test_the_scale_sets_all_sizes_in_every_combination(experiment: str, scale: str, callbacks: str) -> None:
    check_sizes(experiment, scale, [f"callbacks=[{callbacks}]"])


def check_sizes(experiment: str, scale: str, overrides: list[str]) -> None:
    config = compose("train", [f"+experiment={experiment}", f"scale={scale}", *overrides, "paths.run=."])
    resolved = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    sizes = read(CONF / "scale" / f"{scale}.yaml")
    assert resolved["scale"] == sizes
    assert resolved["name"] == experiment
    epochs = "hrnet_max_epochs" if resolved["model"]["predicts"] == "images" else "epochs"
    assert resolved["trainer"]["max_epochs"] == sizes[epochs]
    assert resolved["data"]["module"]["batch_size"] == sizes["batch_size"]
    assert resolved["data"]["observer"]["camera"]["width"] == sizes["image"]
    assert resolved["ego"]["resolution"] == resolved["ground_truth"]["resolution"] == sizes["resolution"]
    assert resolved["model"]["optimizer"]["lr"] == sizes["learning_rate"]
    final = "hrnet_final_learning_rate" if epochs == "hrnet_max_epochs" else "final_learning_rate"
    assert resolved["model"]["scheduler"]["eta_min"] == sizes[final]
    assert (
        resolved["model"]["scheduler"]["T_max"]
        == sizes["hrnet_epochs" if epochs == "hrnet_max_epochs" else "epochs"]
    )
    assert resolved["evaluation"]["cell_widths"] == sizes["cell_widths"]
    validate(config)


def test_scales_have_the_same_keys() -> None:
    keys = [list(read(CONF / "scale" / f"{scale}.yaml")) for scale in options("scale")]
    assert all(names == keys[0] for names in keys)


@pytest.mark.parametrize("experiment", options("experiment"))
def test_no_experiment_sets_a_size(experiment: str) -> None:
    assert "scale" not in read(CONF / "experiment" / f"{experiment}.yaml")
    assert "scale" not in str(read(CONF / "experiment" / f"{experiment}.yaml").get("defaults"))


def test_paper_holds_the_appendix() -> None:
    from imagination.geometry.grid import cells_of
    from imagination.geometry.morphology import kernel_cells

    config = compose("train", ["+experiment=chair_unet", "scale=paper"])
    scale, kernels = config.scale, config.kernels
    assert (scale.learning_rate, scale.batch_size, scale.buffer_size) == (0.001, 108, 12288)
    assert (scale.update_interval, scale.update_batches, scale.parallel_scenes) == (5, 20, 16)
    assert (scale.scenes.test, scale.viewpoint_sets, scale.orientations) == (60, 10, 2)
    assert list(scale.cell_widths) == [3.0, 2.5, 2.0]
    assert cells_of(scale.ego_extent, scale.resolution) == 261
    assert cells_of(scale.world_extent, scale.resolution) == 2001
    sizes = kernels.imaginable, kernels.neighbourhood, kernels.ground_truth
    assert [kernel_cells(size, scale.resolution) for size in sizes] == [50, 31, 30]
    assert config.model.optimizer._target_ == "torch.optim.Adam"
    assert (scale.hflip_probability, scale.tta_hflip, scale.postprocess_dilation) == (0.0, False, 0.0)
    assert list(scale.heights) == [] and scale.balanced_fraction == 0.0 and scale.encoder_shrink == 1
    assert config.aggregation_factor == 0.9
    assert config.callbacks.replay_buffer.aggregation_factor == 0.9
    assert config.mapping.registration.aggregation_factor == 0.9


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("kernels.imaginable=-1", r"kernels.imaginable: got -1.*\[0.005, 10.0\] m"),
        ("kernels.ground_truth=nan", "kernels.ground_truth: got nan"),
        ("scale.resolution=0", "scale.resolution: got 0"),
        ("aggregation_factor=1.5", r"aggregation_factor: got 1.5.*\[0.0, 1.0\]"),
        ("aggregation_factor=much", "aggregation_factor: got 'much'"),
        ("scale.cell_widths=[3.0,0]", "scale.cell_widths: got 0"),
        ("scale.cell_widths=3.0", "scale.cell_widths: got 3.0"),
        ("scale.tta_hflip=maybe", "scale.tta_hflip: got 'maybe'"),
        ("scale.precision=half", "scale.precision: got 'half'.*16-mixed"),
        ("trainer.precision=64-true", "trainer.precision: got '64-true'"),
        ("evaluation.precision=half", "evaluation.precision: got 'half'"),
        ("scale.epochs=2.5", "scale.epochs: got 2.5"),
        ("trainer.max_epochs=null", "trainer.max_epochs: got None"),
        ("scale.world_extent=9000", r"map of 9000.*got \d+ cells a side"),
        ("unit_categories=[sofa]", "got 'sofa'.*bed, chair, table"),
        ("unit_categories=[]", "unit_categories: got none.*chair, bed, table"),
        ("name=a/b", "name: got 'a/b'"),
        ("name=default", "name: got 'default'"),
    ],
)
def test_invalid_values_are_refused(override: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        validate(compose("train", [override]))


def test_a_baseline_trains_as_long_as_the_units() -> None:
    for override in ("scale.epochs=85", "scale.hrnet_max_epochs=83"):
        with pytest.raises(UserError, match="scale.hrnet_epochs: got 84.*scale.epochs"):
            validate(compose("train", ["+experiment=segmentation_hrnet", "scale=small", override]))
        validate(compose("train", ["+experiment=chair_unet", "scale=small", override]))


def test_a_small_imaginable_kernel_warns() -> None:
    with pytest.warns(UserWarning, match="kernels.imaginable .*0.5"):
        validate(compose("train", ["kernels.imaginable=0.5"]))


def test_unknown_options_list_those_that_exist() -> None:
    with pytest.raises(HydraException, match=r"(?s)scale/huge.*paper.*small.*test"):
        compose("train", ["scale=huge"])


def test_a_category_is_added_by_config() -> None:
    row = "+categories.stool={colour: [90, 160, 90], aliases: {procedural: [stool]}}"
    config = compose("train", [row, "unit_categories=[stool]"])
    validate(config)
    assert list(config.categories) == ["chair", "bed", "table", "stool"]


@pytest.mark.parametrize("scale", options("scale"))
def test_the_buffer_holds_enough_for_the_first_batch(scale: str) -> None:
    config = compose("train", [f"scale={scale}", "paths.run=."])
    size, buffer = config.scale, ReplayBuffer(config.scale.buffer_size, config.aggregation_factor)
    collection = size.parallel_scenes * size.update_interval
    for _ in range(size.prefill_steps // size.update_interval + 1):
        buffer.insert({"pose": np.zeros((collection, 3))})
    assert len(buffer.draw(size.batch_size, np.random.default_rng(0))["pose"]) == size.batch_size


def test_an_unknown_precision_is_refused_by_name() -> None:
    assert resolved("32-true") == "32-true" and resolved("auto") in ("32-true", "bf16-mixed")
    with pytest.raises(UserError, match="precision: got 'half'.*16-mixed"):
        resolved("half")


@pytest.mark.parametrize("category", ["chair", "bed", "table", "all"])
def test_the_best_recipe_differs_from_the_paper_in_loss_and_update_rule(category: str) -> None:
    paper = "all_units" if category == "all" else f"{category}_unet"
    ours, theirs = (
        OmegaConf.to_container(compose("train", [f"+experiment={name}", "paths.run=."]), resolve=True)
        for name in (f"{category}_best", paper)
    )
    assert ours["model"]["loss"]["_target_"].endswith("BCEDice")
    assert theirs["model"]["loss"]["_target_"].endswith("WeightedBCE")
    assert ours["mapping"]["registration"]["_target_"].endswith(".Mean")
    for config in (ours, theirs):
        del config["name"], config["sweep_dir"]
        del config["model"]["loss"], config["model"]["module"]["loss"]
        del config["mapping"]["registration"], config["evaluation"], config["callbacks"]["mapping_evaluation"]
    assert ours == theirs
