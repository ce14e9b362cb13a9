"""The evaluation's config: the checkpoint's run, changed by the command line."""

import os
import shutil
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.config.compose import compose
from imagination.config.overrides import result_overrides
from imagination.data.datamodule import TRAINING_SCENES
from imagination.evaluation.checkpoint_config import check_scenes, evaluation_config
from imagination.runs.checkpoint import KEY, Checkpoint, hyperparameters
from imagination.scenes.procedural import source as procedural
from imagination.scenes.source import SPLITS, SceneSource, Split
from imagination.utils import code_hash
from imagination.utils.errors import UserError
from tests.conftest import ROOT
from tests.data.test_datamodule import data
from tests.helpers.room_source import Rooms
from tests.helpers.scanned_buildings import write_matterport
from tests.helpers.scene_sources import source


def checkpoint(choices: list[str], *values: str, name: str = "best") -> Checkpoint:
    """Return the checkpoint of a run with these overrides, without weights."""
    config = compose("train", [*choices, *values, "paths.run=."])
    OmegaConf.update(config, "choices", [*choices, *values])
    return Checkpoint(Path(f"{name}.ckpt"), {KEY: hyperparameters(config), "state_dict": {}})


@pytest.fixture(scope="module")
def chair() -> Checkpoint:
    return checkpoint(["scale=test"])


def node(config: DictConfig, key: str) -> Any:
    value = OmegaConf.select(config, key)
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


NODES = (
    "ego",
    "world",
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
    values = ["seed=3", "evaluation.viewpoint_sets=2", "kernels.neighbourhood=0.8", "name=mine"]
    values += [
        "evaluation.cell_widths=[4.0]",
        "mapping.segmentation.max_range=3.5",
        "camera.width=40",
        "kernels.imaginable=0.9",
    ]  # in the place of references
    trained = compose("train", [*choices, *values, "paths.run=."])
    evaluated = evaluation_config([checkpoint(choices, *values)], ["ckpt=best.ckpt"])
    for key in NODES:
        assert node(evaluated, key) == node(trained, key), key


def test_an_override_reaches_everything_that_refers_to_it() -> None:
    kept = checkpoint(["scale=test"], "seed=3", "aggregation_factor=0.5", "evaluation.viewpoint_sets=2")
    changes = ["aggregation_factor=0.9", "evaluation.viewpoint_sets=1", "evaluation.cell_widths=[4]"]
    config = evaluation_config([kept], ["ckpt=best.ckpt", *changes])
    assert config.seed == 3
    assert config.mapping.registration.aggregation_factor == 0.9  # the default, although the run had another
    assert config.evaluation.viewpoint_sets == 1
    assert config.evaluation.cell_widths == [4]


@pytest.mark.parametrize(
    "change",
    [
        "model=projected",
        "model/encoder=timm",
        "model.unit.postprocess_dilation=0.1",
        "model.tta_hflip=false",
        "model.postprocess_dilation=0.1",
    ],
)
def test_networks_stay_as_they_were_trained(chair: Checkpoint, change: str) -> None:
    with pytest.raises(UserError, match=f"got {change}"):
        evaluation_config([chair], ["ckpt=best.ckpt", change])


def test_the_registration_rule_can_be_swept(chair: Checkpoint) -> None:
    config = evaluation_config([chair], ["ckpt=best.ckpt", "mapping/registration=latest"])
    assert config.evaluation.approaches.imagination.rule._target_.endswith("Latest")
    assert config.evaluation.approaches.seg_gt.rule._target_.endswith("Max")


def test_units_of_several_categories_stand_side_by_side(chair: Checkpoint) -> None:
    bed = checkpoint(["+experiment=bed_unet", "scale=test"], name="bed")
    network = checkpoint(["+experiment=segmentation_hrnet", "scale=test"], name="network")
    assert evaluation_config([bed, chair], ["ckpt=[a,b]"]).unit_categories == ["bed", "chair"]
    assert evaluation_config([bed, chair, network], ["ckpt=[a,b,c]"]).unit_categories == ["bed", "chair"]
    assert evaluation_config([network], ["ckpt=c"]).unit_categories == ["chair", "bed", "table"]
    every = checkpoint(["+experiment=all_units", "scale=test"], name="every")
    assert evaluation_config([every], ["ckpt=a", "unit_categories=[table]"]).unit_categories == ["table"]


@pytest.mark.parametrize(
    ("experiments", "message"),
    [
        (
            ["chair_unet", "all_units"],
            r"ckpt: got a\.ckpt and b\.ckpt.* chair",
        ),
        (
            ["chair_unet", "bed_unet", "segmentation_hrnet", "segmentation_hrnet"],
            r"ckpt: got c\.ckpt and d\.ckpt",
        ),
    ],
)
def test_two_checkpoints_of_one_category_are_refused_by_name(experiments: list[str], message: str) -> None:
    given = zip(experiments, "abcd", strict=False)
    with pytest.raises(UserError, match=message):
        evaluation_config(
            [checkpoint([f"+experiment={one}", "scale=test"], name=name) for one, name in given], []
        )


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            "ego.resolution=0.1",
            r"bed\.ckpt: .*bed .*0\.1 m.* best\.ckpt .*chair",
        ),
        (
            "camera.width=40",
            r"bed\.ckpt: .*camera.*40.* best\.ckpt .*48",
        ),
    ],
)
def test_checkpoints_that_differ_are_refused_with_both(chair: Checkpoint, value: str, message: str) -> None:
    bed = checkpoint(["+experiment=bed_unet", "scale=test"], value, name="bed")
    with pytest.raises(UserError, match=message):
        evaluation_config([chair, bed], ["ckpt=[a,b]"])


def test_a_category_that_no_checkpoint_gives_is_refused(chair: Checkpoint) -> None:
    network = checkpoint(
        ["+experiment=segmentation_hrnet", "scale=test"], "unit_categories=[chair]", name="net"
    )
    with pytest.raises(UserError, match=r"net\.ckpt: .*chair.* add .*bed"):
        evaluation_config(
            [chair, checkpoint(["+experiment=bed_unet", "scale=test"], name="bed"), network], []
        )


def test_one_segmentation_network_is_enough(chair: Checkpoint) -> None:
    network = checkpoint(["+experiment=segmentation_hrnet", "scale=test"], name="net")
    assert evaluation_config([chair], ["ckpt=a", "ade20k=weights"]).ade20k == "weights"
    with pytest.raises(UserError, match=r"ade20k: got weights.*net\.ckpt"):
        evaluation_config([chair, network], ["ckpt=[a,b]", "ade20k=weights"])


def test_the_study_adds_its_rows(chair: Checkpoint) -> None:
    config = evaluation_config([chair], ["ckpt=a", "study=paper"])
    assert config.name == "study" and config.evaluation.known_scenes == config.data.splits.test
    assert list(config.evaluation.approaches)[-2:] == ["rgb_shuffled", "oracle"]


@pytest.mark.parametrize("override", ["unit_categories=[chair,bed]", "ego.resolution=0.1"])
def test_a_checkpoint_of_something_else_is_refused(chair: Checkpoint, override: str) -> None:
    with pytest.raises(UserError, match=r"best\.ckpt: .*chair .*0\.12 m"):
        evaluation_config([chair], ["ckpt=best.ckpt", override])


@pytest.mark.parametrize("override", ["camera.width=40", "ego.extent=4.2", "camera.mount_height=0.9"])
def test_another_camera_or_map_is_refused(chair: Checkpoint, override: str) -> None:
    with pytest.raises(UserError, match=r"best\.ckpt: .*(camera|ego)="):
        evaluation_config([chair], ["ckpt=best.ckpt", override])


def test_nothing_but_plain_values_is_taken_from_a_checkpoint(chair: Checkpoint) -> None:
    for value in ("${oc.env:HOME}", "_target_"):
        strange = Checkpoint(chair.path, deepcopy(chair.state))
        strange.state[KEY]["values"]["name"] = value
        with pytest.raises(UserError, match="do not use"):
            evaluation_config([strange], ["ckpt=best.ckpt"])


def trained_in(source: SceneSource, *scenes: str) -> Checkpoint:
    """Return a checkpoint that was trained in scenes of a source."""
    fingerprints = {source.identity(scene): source.fingerprint(scene) for scene in scenes}
    return Checkpoint(Path(f"{scenes[0]}.ckpt"), {"SceneData": {TRAINING_SCENES: fingerprints}})


def test_training_scenes_are_not_evaluated(caplog: pytest.LogCaptureFixture) -> None:
    rooms = Rooms(3)
    check_scenes([trained_in(rooms, "train_0", "train_1")], rooms)
    assert caplog.text == ""
    check_scenes([trained_in(rooms, "train_0"), trained_in(rooms, "train_0", "train_1")], rooms)
    assert "different scenes" in caplog.text
    check_scenes([Checkpoint(Path("unknown.ckpt"), {"callbacks": {}})], rooms)
    assert "unknown.ckpt holds no training scenes" in caplog.text
    for scene in ("val_2", "test_0"):
        with pytest.raises(UserError, match=rf"ckpt: {scene}\.ckpt.*rooms {scene}.*split"):
            check_scenes([trained_in(rooms, "train_0"), trained_in(rooms, scene)], rooms)


class Rebuilt(Rooms):
    """Rooms whose data or settings have changed."""

    def fingerprint(self, scene: str) -> str:
        return f"{super().fingerprint(scene)} rebuilt"


def test_other_versions_of_the_same_scenes_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    check_scenes([trained_in(Rooms(3), "train_0"), trained_in(Rebuilt(3), "train_0")], Rooms(3))
    assert "different versions of the scene source" in caplog.text


def test_training_scenes_are_not_evaluated_after_an_edit_of_the_builders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    homes: SceneSource = instantiate(compose("render", ["scale=test"]).data.scenes)
    trained = trained_in(homes, *homes.scenes("test"))
    copy = tmp_path / "imagination"
    shutil.copytree(ROOT / "imagination", copy, ignore=shutil.ignore_patterns("__pycache__"))
    with open(copy / "scenes" / "procedural" / "scene_builder.py", "a") as builder:
        builder.write("# a comment\n")
    monkeypatch.setattr(code_hash, "__file__", str(copy / "utils" / "code_hash.py"))
    monkeypatch.setattr(procedural, "_code_version", procedural._code_version.__wrapped__)
    assert homes.fingerprint("test_0000") not in trained.scenes.values()
    with pytest.raises(UserError, match=r"procedural seed=1 test_0000"):
        check_scenes([trained], homes)


def test_a_scan_is_recognised_in_another_split_and_with_other_times(tmp_path: Path) -> None:
    names = ["one", "two", "three"]
    for name in names:
        write_matterport(tmp_path, name)

    def scans(*order: str) -> SceneSource:
        for split, name in zip(SPLITS, order, strict=True):
            (tmp_path / f"scenes_{split}.txt").write_text(name)
        return source(tmp_path, "data/scenes=matterport3d", f"data.scenes.folder={tmp_path}")

    before = scans("one", "two", "three")
    trained = trained_in(before, *before.scenes("train"))
    check_scenes([trained], before)
    for path in tmp_path.rglob("one*"):
        os.utime(path, (0, 0))
    moved = scans("three", "two", "one")
    assert moved.fingerprint("one_0") not in trained.scenes.values()
    with pytest.raises(UserError, match=r"one_0\.ckpt was trained in matterport3d one_0.*'test'"):
        check_scenes([trained], moved)


def test_a_checkpoint_without_identities_is_refused(tmp_path: Path) -> None:
    """Versions before wrote fingerprints by name."""
    rooms = Rooms(3)
    old = {"SceneData": {"scenes": {scene: rooms.fingerprint(scene) for scene in rooms.scenes("train")}}}
    with pytest.raises(UserError, match=r"checkpoint .*old\.ckpt: .*another version.*train again"):
        check_scenes([Checkpoint(tmp_path / "old.ckpt", old)], rooms)


def test_the_data_module_names_the_training_scenes(tmp_path: Path) -> None:
    module = data(tmp_path, source=Rooms(2))
    scenes = Checkpoint(Path("best.ckpt"), {"SceneData": module.state_dict()}).scenes
    assert list(scenes) == ["rooms train_0", "rooms train_1"] and len(set(scenes.values())) == 2
    with pytest.raises(UserError, match="rooms train_1"):
        check_scenes([Checkpoint(Path("best.ckpt"), {"SceneData": module.state_dict()})], Swapped(2))


class Swapped(Rooms):
    """Rooms whose training scenes are test scenes."""

    def scenes(self, split: Split) -> list[str]:
        return super().scenes("train" if split == "test" else split)


@pytest.mark.parametrize(
    ("overrides", "key", "expected"),
    [
        (["callbacks=[default,early_stopping]", "callbacks.early_stopping.min_delta=0.01"], "seed", 0),
        (["data={workers: 2, batch_size: 8}"], "data.batch_size", 8),
        (["trainer={max_epochs: 3, devices: 2}"], "trainer.devices", 1),
        (["data=shards", "data.shards=../views"], "data.shards", "../views"),
        (["kernels.ground_truth=${kernels.imaginable}"], "kernels.ground_truth", 1.0),
        (["trainer=ddp"], "trainer.accelerator", "auto"),
    ],
)
def test_what_a_run_stores_is_evaluated(overrides: list[str], key: str, expected: Any) -> None:
    """Whatever a user overrides, the run's checkpoint can be evaluated, and devices are not taken from it."""
    words = ["experiment=chair_unet", "scale=test", *overrides]
    config = compose("train", [*words, "paths.run=."])
    config.choices = result_overrides(words, config)
    saved = Checkpoint(Path("best.ckpt"), {KEY: hyperparameters(config), "state_dict": {}})
    assert node(saved.config, key) == node(evaluation_config([saved], []), key) == expected
