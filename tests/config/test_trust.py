"""Configs from files: each place instantiates only classes of its role, and writes only below the run and the cache."""

import re
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from imagination.config.compose import compose
from imagination.config.trust import check_targets
from imagination.config.written_paths import check_paths
from imagination.utils.errors import UserError
from tests.conftest import ROOT

EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))


def config(*overrides: str) -> DictConfig:
    return compose("train", ["+experiment=chair_unet", "scale=test", "paths.run=run", *overrides])


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_our_own_targets_are_trusted(experiment: str) -> None:
    check_targets(compose("train", [f"+experiment={experiment}", "paths.run=."]))


@pytest.mark.parametrize(
    "overrides",
    [
        ("data=shards", "data.shards=/data/views"),
        ("data/scenes=hm3d",),  # its layout is an object inside that of the scene source
        ("data/furniture=sweethome3d",),
        ("model=projected", "model/backbone=fpn", "model/loss=bce_dice", "mapping/registration=mean"),
        (
            "model.optimizer._target_=torch.optim.AdamW",
            "+callbacks.rate._target_=lightning.pytorch.callbacks.Timer",
        ),
        ("model.scheduler._target_=torch.optim.lr_scheduler.CosineAnnealingLR",),
        ("logger=many",),
        ("logger=mlflow",),  # in a folder beside the runs, as the installed conf has it
        ("model/optimizer=sgd", "model/scheduler=step"),
        ("trainer=ddp", "debug=profiler"),
        ("+trainer.profiler._target_=lightning.pytorch.profilers.SimpleProfiler",),
    ],
)
def test_options_and_classes_of_a_role_are_trusted(overrides: tuple[str, ...]) -> None:
    own = config(*overrides)
    check_targets(own)
    check_paths(own, OmegaConf.create({}))


@pytest.mark.parametrize(
    ("place", "target"),
    [
        ("model.optimizer", "os.system"),
        ("model.optimizer", "hydra.utils.call"),
        ("model.optimizer", "hydra.utils.get_method"),
        ("model.optimizer", "imagination.utils.atomic_io.os.replace"),
        ("model.optimizer", "torch.load"),
        ("model.optimizer", "torch.optim.lr_scheduler.StepLR"),  # of another role
        ("model.optimizer", "no_such_package.Thing"),
        ("model.optimizer", "torch.optim.NoSuchOptimizer"),
        ("model.optimizer", "${name}"),
        ("model.optimizer", ["torch.optim.Adam"]),
        ("model.module", "imagination.models.lit_unit.LitUnit.load_from_checkpoint"),
        ("callbacks.mine", "imagination.utils.cache.Cache"),
        ("callbacks.mine", "imagination.utils.atomic_io.write_text"),
        ("callbacks.mine", "imagination.views.pose_samplers.UniformPoses"),
        ("callbacks.mine", "lightning.pytorch.trainer.Trainer"),
        ("callbacks.mine", "lightning.pytorch.callbacks.ModelCheckpoint"),  # deletes what a checkpoint names
        ("callbacks.mine", "lightning.fabric.utilities.cloud_io._load"),
        ("callbacks.best_checkpoint.more", "imagination.utils.cache.Cache"),
        ("data.sampler", "imagination.deployment.torch_backend.ExportedModule"),  # callable, but no sampler
        ("data.sampler", "imagination.mapping.update_rules.Mean"),
        ("data.scenes", "imagination.views.pose_samplers.UniformPoses"),
        ("mapping.registration", "imagination.scenes.sensor.IdealSensor"),
        ("evaluation.approaches.seg_gt.evidence", "imagination.mapping.update_rules.Mean"),
        ("trainer", "imagination.utils.cache.Cache"),
        ("trainer.plugins", "imagination.runs.checkpoint.CheckpointFiles"),
        ("camera", "imagination.geometry.grid.EgoGrid.of_extent"),
        ("elsewhere", "imagination.geometry.projection.Band"),
    ],
)
def test_a_class_of_another_role_is_refused(place: str, target: Any) -> None:
    changed = config()
    OmegaConf.update(changed, place, {"_target_": target}, force_add=True)
    with pytest.raises(
        UserError, match=f"^({re.escape(place)}: got the _target_|_target_: got '[\\w.]+', which cannot)"
    ):
        check_targets(changed)


@pytest.mark.parametrize(
    ("place", "key"),
    [
        ("callbacks.best_checkpoint", "_args_"),
        ("callbacks.best_checkpoint", "_recursive_"),
        ("callbacks.best_checkpoint", "_partial_"),
        ("data", "_recursive_"),
        ("", "_args_"),
    ],
)
def test_special_keys_are_refused(place: str, key: str) -> None:
    changed = config()
    OmegaConf.update(changed, f"{place}.{key}".lstrip("."), True, force_add=True)
    with pytest.raises(UserError, match=f"{place}: got the key '{key}'"):
        check_targets(changed)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("trainer.default_root_dir", "elsewhere"),
        ("trainer.default_root_dir", "${paths.run}/../elsewhere"),
        ("trainer.profiler", {"_target_": "lightning.pytorch.profilers.SimpleProfiler", "dirpath": "/tmp"}),
        ("callbacks.best_checkpoint.dirpath", "/elsewhere"),
        ("callbacks.best_checkpoint.dirpath", "~"),
        ("callbacks.best_checkpoint.filename", "../../../elsewhere"),
        ("callbacks.best_checkpoint.filename", "/elsewhere"),
        ("callbacks.mapping_evaluation.folder", "elsewhere"),
        ("callbacks.mapping_evaluation.folder", "${name}"),
        ("callbacks.mine", {"_target_": "lightning.pytorch.callbacks.OnExceptionCheckpoint", "dirpath": "x"}),
        ("logger.tensorboard.save_dir", "elsewhere"),
        ("logger.tensorboard.name", "../../elsewhere"),
        ("logger.tensorboard.version", "/elsewhere"),
        ("logger.tensorboard.tracking_uri", "file:/elsewhere"),
        ("logger.mlflow", {"tracking_uri": "${name}/mlflow"}),
        ("logger.tensorboard.tags", ["s3://elsewhere/bucket"]),
        ("data.shards", "s3://elsewhere/views"),
        ("data.module.shards", "local:///elsewhere"),
        ("data.module.shard_cache", "elsewhere"),
        ("data.module.shard_cache", "${paths.cache}/../elsewhere"),
        ("logger.tensorboard.save_dir", "a\0b"),
    ],
)
def test_paths_outside_the_run_are_refused(key: str, value: Any) -> None:
    changed = config()
    OmegaConf.update(changed, key, value, force_add=True)
    with pytest.raises(UserError, match=rf"{key}\S*: got "):
        check_paths(changed, config())
    check_paths(changed, changed)  # the command has the same path


def test_paths_of_a_plugin_are_known_by_their_annotation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = config()
    spikes = {"_target_": "tests.config.test_trust.Writer", "output": "elsewhere"}
    OmegaConf.update(changed, "callbacks.spikes", spikes, force_add=True)
    with pytest.raises(UserError, match="callbacks.spikes.output: got 'elsewhere'"):
        check_paths(changed, config())
    changed.callbacks.spikes.output = "run/inside"
    check_paths(changed, config())


class Writer:
    """Callback with a path that its name does not show."""

    def __init__(self, output: str | Path) -> None:
        self.output = output
