"""Each experiment composes at each scale, the sizes of the scale apply, and invalid values are refused by name."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.config.key_roles import KEYS
from imagination.config.overrides import leaves
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


def sizes_of(scale: str) -> dict[str, Any]:
    """Return the values of a scale by dotted key."""
    return dict(leaves(read(CONF / "scale" / f"{scale}.yaml")))


def check_sizes(experiment: str, scale: str, overrides: list[str]) -> None:
    config = compose("train", [f"experiment={experiment}", f"scale={scale}", *overrides, "paths.run=."])
    sizes = sizes_of(scale)
    baseline = {
        "trainer.max_epochs": "hrnet.max_epochs",
        "trainer.check_val_every_n_epoch": "hrnet.check_val_every_n_epoch",
        "data.micro_batches": "hrnet.micro_batches",
        "model.final_learning_rate": "hrnet.final_learning_rate",
    }
    for key in sizes:
        source = baseline.get(key, key) if experiment == "segmentation_hrnet" else key
        assert OmegaConf.select(config, key) == sizes[source], key
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    assert resolved["name"] == experiment
    assert resolved["data"]["module"]["batch_size"] == sizes["data.batch_size"]
    assert resolved["data"]["observer"]["camera"]["width"] == sizes["camera.width"]
    assert resolved["ground_truth"]["resolution"] == sizes["ego.resolution"]
    node, epochs = ("hrnet", "epochs") if experiment == "segmentation_hrnet" else ("model", "max_epochs")
    assert resolved["model"]["scheduler"]["eta_min"] == sizes[f"{node}.final_learning_rate"]
    assert resolved["model"]["scheduler"]["T_max"] == sizes[f"{node.replace('model', 'trainer')}.{epochs}"]
    validate(config)


def test_scales_set_the_same_keys() -> None:
    keys = [list(sizes_of(scale)) for scale in options("scale")]
    assert all(names == keys[0] for names in keys)
    assert set(keys[0]) <= {*KEYS, "data.splits", "data.eval_views"}


@pytest.mark.parametrize("experiment", options("experiment"))
def test_no_experiment_sets_a_value_of_a_scale(experiment: str) -> None:
    """The baseline has values of its own in each scale, in the node hrnet."""
    content = read(CONF / "experiment" / f"{experiment}.yaml")
    assert "scale" not in str(content.get("defaults"))
    values = dict(leaves({key: value for key, value in content.items() if key != "defaults"}))
    for key in values.keys() & sizes_of("small").keys():
        assert experiment == "segmentation_hrnet" and values[key].startswith("${hrnet."), key


def test_an_experiment_may_set_a_value_of_a_scale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An experiment comes after the scale in the defaults, as in lightning-hydra-template."""
    folder = tmp_path / "plugins" / "mine" / "conf" / "experiment"
    folder.mkdir(parents=True)
    (folder / "mine.yaml").write_text("# @package _global_\nname: mine\ntrainer: {max_epochs: 7}\n")
    monkeypatch.chdir(tmp_path)
    config = compose("train", ["experiment=mine", "scale=test", "paths.run=."])
    assert config.trainer.max_epochs == config.model.scheduler.T_max == 7


def test_paper_holds_the_appendix() -> None:
    from imagination.geometry.grid import cells_of
    from imagination.geometry.morphology import kernel_cells

    config = compose("train", ["+experiment=chair_unet", "scale=paper"])
    data, model, kernels, buffer = config.data, config.model, config.kernels, config.callbacks.replay_buffer
    assert (model.optimizer.lr, data.batch_size, buffer.size) == (0.001, 108, 12288)
    assert (buffer.update_interval, buffer.update_batches, data.parallel_scenes) == (5, 20, 16)
    evaluation = config.evaluation
    assert (data.splits.test, evaluation.viewpoint_sets, evaluation.orientations) == (60, 10, 2)
    assert list(evaluation.cell_widths) == [3.0, 2.5, 2.0]
    assert cells_of(config.ego.extent, config.ego.resolution) == 261
    assert cells_of(config.world.extent, config.world.resolution) == 2001
    sizes = kernels.imaginable, kernels.neighbourhood, kernels.ground_truth
    assert [kernel_cells(size, config.ego.resolution) for size in sizes] == [50, 31, 30]
    assert model.optimizer._target_ == "torch.optim.Adam"
    assert model.final_learning_rate == model.optimizer.lr
    assert (data.hflip_probability, model.tta_hflip, model.postprocess_dilation) == (0.0, False, 0.0)
    assert list(model.heights) == [] and data.balanced_fraction == 0.0 and model.encoder_shrink == 1
    assert config.aggregation_factor == 0.9
    assert buffer.aggregation_factor == 0.9
    assert config.mapping.registration.aggregation_factor == 0.9


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("kernels.imaginable=-1", r"kernels.imaginable: got -1.*\[0.005, 10.0\] m"),
        ("kernels.ground_truth=nan", "kernels.ground_truth: got nan"),
        ("ego.resolution=0", "ego.resolution: got 0"),
        ("aggregation_factor=1.5", r"aggregation_factor: got 1.5.*\[0.0, 1.0\]"),
        ("aggregation_factor=much", "aggregation_factor: got 'much'"),
        ("evaluation.cell_widths=[3.0,0]", "evaluation.cell_widths: got 0"),
        ("evaluation.cell_widths=3.0", "evaluation.cell_widths: got 3.0"),
        ("model.tta_hflip=maybe", "model.tta_hflip: got 'maybe'"),
        ("trainer.precision=half", "trainer.precision: got 'half'.*16-mixed"),
        ("trainer.precision=64-true", "trainer.precision: got '64-true'"),
        ("evaluation.precision=half", "evaluation.precision: got 'half'"),
        ("trainer.max_epochs=2.5", "trainer.max_epochs: got 2.5"),
        ("trainer.max_epochs=null", "trainer.max_epochs: got None"),
        ("world.extent=9000", r"map of 9000.*got \d+ cells a side"),
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
    for override in ("hrnet.collection_epochs=85", "hrnet.max_epochs=83"):
        with pytest.raises(UserError, match="hrnet.epochs: got 84"):
            validate(compose("train", ["+experiment=segmentation_hrnet", "scale=small", override]))
    for scale in options("scale"):
        sizes = sizes_of(scale)
        assert sizes["hrnet.collection_epochs"] == sizes["trainer.max_epochs"]


def test_a_small_imaginable_kernel_warns() -> None:
    with pytest.warns(UserWarning, match="kernels.imaginable .*0.5"):
        validate(compose("train", ["kernels.imaginable=0.5"]))


def test_a_category_is_added_by_config() -> None:
    row = "+categories.stool={colour: [90, 160, 90], aliases: {procedural: [stool]}}"
    config = compose("train", [row, "unit_categories=[stool]"])
    validate(config)
    assert list(config.categories) == ["chair", "bed", "table", "stool"]


@pytest.mark.parametrize("scale", options("scale"))
def test_the_buffer_holds_enough_for_the_first_batch(scale: str) -> None:
    config = compose("train", [f"scale={scale}", "paths.run=."])
    values = config.callbacks.replay_buffer
    buffer = ReplayBuffer(values.size, config.aggregation_factor)
    collection = config.data.parallel_scenes * values.update_interval
    for _ in range(values.prefill_steps // values.update_interval + 1):
        buffer.insert({"pose": np.zeros((collection, 3))})
    assert (
        len(buffer.draw(config.data.batch_size, np.random.default_rng(0))["pose"]) == config.data.batch_size
    )


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
        del config["name"]
        del config["model"]["loss"], config["model"]["module"]["loss"]
        del config["mapping"]["registration"], config["evaluation"], config["callbacks"]["mapping_evaluation"]
    assert ours == theirs
