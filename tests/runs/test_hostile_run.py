"""Hostile run folders: resuming them changes nothing outside the run, and blocks on nothing."""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.callbacks import ModelCheckpoint
from omegaconf import DictConfig, OmegaConf, open_dict

from imagination.callbacks.model_checkpoint import MovableCheckpoint
from imagination.config.plugin_registry import core_conf
from imagination.config.search_path import register_plugins
from imagination.runs.composed_config import END
from imagination.runs.finished_trainings import newest_run
from imagination.runs.folder import COMPOSED, LOG, check_links
from imagination.runs.resume import open_run
from imagination.train import build
from imagination.utils.errors import UserError
from tests.utils.test_cache import make_victim, snapshot

Values = dict[str, Any]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Folder in which commands run, with a victim and a command that resumes the run in outputs/chair_unet/run."""
    monkeypatch.chdir(tmp_path)
    make_victim(tmp_path / "victim")
    (tmp_path / "outputs" / "chair_unet" / "run").mkdir(parents=True)
    (tmp_path / "outputs" / "chair_unet" / "latest").symlink_to("run")
    yield tmp_path
    HydraConfig.instance().cfg = None


def command(*overrides: str) -> DictConfig:
    """Compose the config of `imagination.train` as its process does."""
    register_plugins()
    with initialize_config_dir(str(core_conf()), version_base="1.3"):
        config = compose("train", ["resume=latest", *overrides], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        del config["hydra"]
    return config


def write_run(here: Path, change: Callable[[Values, str], None] = lambda values, victim: None) -> Path:
    """Write the run folder with a changed config."""
    register_plugins()
    with initialize_config_dir(str(core_conf()), version_base="1.3"):
        config = compose("train", ["experiment=chair_unet", "scale=test", "paths.run=old"])
    values: Any = OmegaConf.to_container(config)
    values["elsewhere"] = str(here / "victim")  # to which other values may refer
    change(values, str(here / "victim"))
    run = here / "outputs" / "chair_unet" / "run"
    (run / COMPOSED).write_text(yaml.safe_dump(values, sort_keys=False) + END)
    return run


def resume(*overrides: str) -> DictConfig:
    """Resume the run as far as the first epoch, and return its config."""
    with open_run(command(*overrides)) as run:
        build(run)
    return run.config


def set_value(key: str, value: Any) -> Callable[[Values, str], None]:
    """Return a change of a value, in which VICTIM stands for the victim's folder."""

    def change(values: Values, victim: str) -> None:
        *parents, last = key.split(".")
        node = values
        for name in parents:
            node = node.setdefault(name, {})
        node[last] = yaml.safe_load(yaml.safe_dump(value).replace("VICTIM", victim))

    return change


CACHE = {"_target_": "imagination.utils.cache.Cache", "folder": "VICTIM", "max_gigabytes": 0.001}
BEST = "callbacks.best_checkpoint"

REFUSED: dict[str, Callable[[Values, str], None]] = {
    "callbacks.mine": set_value("callbacks.mine", CACHE),
    "callbacks.function": set_value("callbacks.function", {"_target_": "shutil.rmtree", "path": "VICTIM"}),
    "model.optimizer": set_value("model.optimizer._target_", "${name}"),
    "model.module": set_value(
        "model.module",
        {
            "_target_": "imagination.models.lit_unit.LitUnit.load_from_checkpoint",
            "checkpoint_path": "VICTIM/x",
        },
    ),
    "data.observer.cache": set_value("data.observer.cache", CACHE),
    "data.module.shard_cache": set_value("data.module.shard_cache", "VICTIM"),
    "callbacks.best_checkpoint.dirpath": set_value("callbacks.best_checkpoint.dirpath", "VICTIM"),
    "callbacks.last_checkpoint.dirpath": set_value("callbacks.last_checkpoint.dirpath", "${elsewhere}"),
    "callbacks.best_checkpoint.filename": set_value(
        "callbacks.best_checkpoint.filename", "../../../../victim/best"
    ),
    "callbacks.mapping_evaluation.folder": set_value("callbacks.mapping_evaluation.folder", "VICTIM"),
    "logger.tensorboard.save_dir": set_value("logger.tensorboard.save_dir", "VICTIM"),
    "logger.tensorboard.name": set_value("logger.tensorboard.name", "../../../victim"),
    "logger.tensorboard": set_value("logger.tensorboard._args_", ["VICTIM"]),
    "trainer.default_root_dir": set_value("trainer.default_root_dir", "VICTIM"),
    "trainer.profiler.dirpath": set_value(
        "trainer.profiler", {"_target_": "lightning.pytorch.profilers.SimpleProfiler", "dirpath": "VICTIM"}
    ),
    "config": set_value("name", "${oc.env:HOME}"),
    "name": set_value("name", "../../victim"),
}
"""Changes by the beginning of the message that refuses them."""


@pytest.mark.parametrize("message", REFUSED)
def test_a_hostile_config_is_refused(here: Path, message: str) -> None:
    write_run(here, REFUSED[message])
    before = snapshot(here / "victim")
    with pytest.raises(UserError, match=f"^{message}.* got "):
        resume()
    assert snapshot(here / "victim") == before


def test_paths_and_cache_are_those_of_the_command(here: Path) -> None:
    """The run itself resumes; the folders that its file names are neither read nor written."""

    def change(values: Values, victim: str) -> None:
        values["paths"] = {"outputs": victim, "cache": victim, "run": victim}
        values["cache"] |= {"folder": victim, "max_gigabytes": 0.001}

    run = write_run(here, change)
    before = snapshot(here / "victim")
    config = resume()
    assert (config.paths.outputs, config.cache.folder) == ("outputs", "outputs/cache")
    assert config.paths.run == str(run.relative_to(here)) and config.cache.max_gigabytes == 20
    config = resume("paths.cache=mine", "cache.max_gigabytes=5")
    assert (config.cache.folder, config.cache.max_gigabytes) == ("mine", 5)
    assert snapshot(here / "victim") == before


@pytest.mark.parametrize(
    "text",
    [
        "a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 30)),
        "".join(f"a{n}: ${{a{n + 1}}}${{a{n + 1}}}\n" for n in range(60)) + "a60: x\n",
        "a: " + "[" * 5_000 + "]" * 5_000 + "\n",
    ],
)
def test_small_files_that_expand_are_refused_quickly(here: Path, text: str) -> None:
    run = write_run(here)
    (run / COMPOSED).write_text((run / COMPOSED).read_text().removesuffix(END) + text + END)
    config = command()
    start = time.perf_counter()
    with pytest.raises(UserError, match=r"composed\.yaml|references"), open_run(config):
        pass
    assert newest_run(here / "outputs", config, finished=False) is None
    assert time.perf_counter() - start < 5.0


LINKS: dict[str, Callable[[Path, Path], None]] = {
    "tables": lambda run, victim: (run / "tables").symlink_to(victim),
    "checkpoints": lambda run, victim: (run / "checkpoints").symlink_to(victim),
    "lock": lambda run, victim: (run / ".lock").symlink_to(victim / "new"),
    "lock that blocks": lambda run, victim: os.mkfifo(run / ".lock"),
    "log": lambda run, victim: (run / LOG).symlink_to(victim / "model.bin"),
    "hard link": lambda run, victim: os.link(victim / "model.bin", run / LOG),
    "checkpoint that blocks": lambda run, victim: os.mkfifo(run / "last.ckpt"),
    "relative": lambda run, victim: (run / "tables").symlink_to("../../../victim"),
}


@pytest.mark.parametrize("case", LINKS)
def test_a_run_folder_with_links_out_of_it_is_refused(here: Path, case: str) -> None:
    run = write_run(here)
    LINKS[case](run, here / "victim")
    before = snapshot(here / "victim")
    with pytest.raises(UserError, match="leads out"), open_run(command()):
        pass
    assert snapshot(here / "victim") == before


def test_links_inside_a_run_folder_are_allowed(here: Path) -> None:
    run = write_run(here)
    (run / "a").mkdir()
    (run / "b").symlink_to("a")
    (run / "c").symlink_to(run / "a")
    (run / "circle").symlink_to("circle")
    (here / "moved").symlink_to(run)
    check_links(here / "moved")


def test_temporary_folders_of_others_stay(here: Path) -> None:
    """Only what `replacing` may have left is removed from a run folder."""
    run = write_run(here)
    for name in (".last.ckpt.abcdefgh.part", ".mine.part", ".tables.abcdefgh.part"):
        (run / name).mkdir()
    (run / ".last.ckpt.abcdefgh.part" / "last.ckpt").write_text("half")
    (run / ".tables.abcdefgh.part" / "mine.txt").write_text("whole")
    (run / ".x.csv.abcdefgh.part").symlink_to(run / ".mine.part")
    with open_run(command()):
        pass
    kept = {".mine.part", ".tables.abcdefgh.part", ".x.csv.abcdefgh.part"}
    assert {path.name for path in run.glob(".*.part")} == kept


@pytest.mark.parametrize("name", ["{victim}/model.bin", "../../victim/model.bin", "..", "s3://bucket/x.ckpt"])
def test_a_checkpoint_names_no_file_to_delete(tmp_path: Path, name: str) -> None:
    """Lightning deletes the previous best checkpoint by the path in the state, which comes from a file."""
    make_victim(tmp_path / "victim")
    folder = tmp_path / "run" / "checkpoints"
    folder.mkdir(parents=True)
    path = name.format(victim=tmp_path / "victim")
    callback = MovableCheckpoint(dirpath=folder, monitor="val/iou")
    state = callback.state_dict() | {
        "best_model_path": path, "kth_best_model_path": path, "last_model_path": path,
        "best_k_models": {path: torch.tensor(0.1)}, "dirpath": str(folder),
    }  # fmt: skip
    callback.load_state_dict(state)
    named = [
        callback.best_model_path,
        callback.kth_best_model_path,
        callback.last_model_path,
        *callback.best_k_models,
    ]
    assert all(not each or Path(os.path.normpath(each)).parent == folder for each in named)
    plain = ModelCheckpoint(dirpath=folder, monitor="val/iou")
    plain.load_state_dict(state)
    assert plain.best_model_path == path  # why Lightning's own class is refused
