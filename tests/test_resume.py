"""Going on with a run, and what a stranger's files may not do."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from imagination.checkpoints import KEY, Checkpoint, CheckpointFiles, ConfigInCheckpoint, read_state
from imagination.config import check_targets, compose
from imagination.errors import UserError
from tests.conftest import ROOT, Command

JOB = ["+experiment=chair_unet", "scale=test"]


def config(*overrides: str) -> DictConfig:
    scale = [] if any(text.startswith("scale=") for text in overrides) else JOB[1:]
    composed = compose("train", [JOB[0], *scale, *overrides, "paths.run=."])
    composed.choices = JOB
    return composed


def checkpoint(path: Path, description: dict[str, Any] | None = None) -> Path:
    """A checkpoint of an untrained unit, or with a description of one's own."""
    from hydra.utils import instantiate

    whole = config("seed=7", "model.loss.alpha_max=12.0")
    state = {"state_dict": instantiate(whole.model.module).state_dict()}
    CheckpointFiles().save_checkpoint(
        {**state, KEY: description or ConfigInCheckpoint(whole).description}, path
    )
    return path


def test_a_checkpoint_brings_its_values_and_no_targets(tmp_path: Path) -> None:
    state = read_state(checkpoint(tmp_path / "a.ckpt"))
    assert "_target_" not in str(state[KEY]) and str(Path.cwd()) not in str(state[KEY])
    read = Checkpoint.read(tmp_path / "a.ckpt")
    assert (read.config.seed, read.config.model.loss.alpha_max, read.config.scale.unit_width) == (
        7,
        12.0,
        4,
    )
    assert read.config.model.unit._target_ == "imagination.units.unit.ImaginationUnit"
    assert read.model().loss.alpha_max == 12.0
    read.require(config())
    with pytest.raises(UserError, match=r"is of chair at 0.12 m a cell, but .* asks for chair at 0.06 m"):
        read.require(config("scale=desk"))


@pytest.mark.parametrize(
    ("choices", "values"),
    [
        (["model=unit"], {"model": {"module": {"_target_": "os.system"}}}),
        (["+experiment=../../secret"], {}),
        (["model.module={_target_: os.system}"], {}),
        (["hydra/launcher=x", "--multirun"], {}),
        ([], {"name": "${oc.env:HOME}"}),
    ],
)
def test_a_strangers_checkpoint_names_no_code(
    tmp_path: Path, choices: list[str], values: dict[str, Any]
) -> None:
    path = checkpoint(tmp_path / "a.ckpt", {"choices": choices, "values": values})
    with pytest.raises(UserError, match="checkpoint .*holds"):
        Checkpoint.read(path).model()


def test_damaged_checkpoints_are_told(tmp_path: Path) -> None:
    path = checkpoint(tmp_path / "a.ckpt")
    content = path.read_bytes()
    for end in (0, 10, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:end])
        with pytest.raises(UserError, match="truncated"):
            Checkpoint.read(path)
    torch.save({"x": 1}, path)
    with pytest.raises(UserError, match="was not written by imagination.train"):
        Checkpoint.read(path)
    torch.save({"x": subprocess.Popen}, path)  # not plain data
    with pytest.raises(UserError, match="more than plain data"):
        Checkpoint.read(path)
    with pytest.raises(UserError, match="there is no such file"):
        Checkpoint.read(tmp_path / "b.ckpt")


def test_a_checkpoint_of_another_model_is_told(tmp_path: Path) -> None:
    values = ConfigInCheckpoint(config()).description["values"]
    values["scale"]["unit_width"] = values["model"]["backbone"]["width"] = 8
    for unit in (values["model"]["unit"], values["model"]["module"]["unit"]):
        unit["backbone"]["width"] = 8
    path = checkpoint(tmp_path / "a.ckpt", {"choices": JOB, "values": values})
    with pytest.raises(UserError, match="its weights do not fit"):
        Checkpoint.read(path).model()


@pytest.mark.parametrize(
    "experiment", sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))
)
def test_our_own_targets_are_trusted(experiment: str) -> None:
    check_targets(compose("train", [f"+experiment={experiment}", "paths.run=."]))


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "imagination.runs.os.remove",
        "imagination.runs.write_text",
        "torch.load",
        "lightning.fabric.utilities.cloud_io._load",
        "no_such_package.Thing",
    ],
)
def test_other_targets_are_refused(target: str) -> None:
    with pytest.raises(UserError, match="_target_: got "):
        check_targets(OmegaConf.create({"list": [{"_target_": target}]}))


def test_a_hidden_target_is_refused() -> None:
    hidden = OmegaConf.create({"model": "${oc.decode:'{_target_: os.system}'}"})
    with pytest.raises(UserError, match="oc.decode"):
        check_targets(hidden)


def test_a_run_goes_on_with_its_own_config_only(command: Command, tmp_path: Path) -> None:
    assert command("train", *JOB, "seed=3", "trainer.max_epochs=1").returncode == 0
    for refused in ("seed=4", "scale=desk", "model=projected"):
        done = command("train", "resume=latest", refused)
        assert done.returncode == 2 and f"got {refused}, but a run goes on with its own config" in done.stderr
    done = command("train", "resume=latest", "trainer.max_epochs=2")
    assert done.returncode == 0, done.stderr
    runs = [path for path in (tmp_path / "outputs" / "chair_unet").iterdir() if not path.is_symlink()]
    assert len(runs) == 1
    description = read_state(runs[0] / "checkpoints" / "last.ckpt")
    assert description["epoch"] == 1 and description[KEY]["values"]["seed"] == 3
    composed = runs[0] / "composed.yaml"
    text = composed.read_text()
    for damaged in (text[: len(text) // 2], "[", text.replace("torch.optim.Adam", "os.system")):
        composed.write_text(damaged)
        done = command("train", "resume=latest")
        assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("experiment", "moment"),
    [("chair_unet", 0.0), ("chair_unet", 0.35), ("chair_unet", 1.1), ("segmentation_hrnet", 0.35)],
)
def test_a_killed_run_ends_as_an_uninterrupted_one(
    tmp_path: Path, command: Command, experiment: str, moment: float
) -> None:
    """SIGKILL some seconds after the first checkpoint, resume: the same weights, the same table."""
    job = [f"+experiment={experiment}", "scale=test", "scale.eval_every=2", "scale.workers=1"]
    if experiment == "segmentation_hrnet":  # beyond the rounds that collect, with a rate that falls
        job += ["scale.hrnet_rounds=6", "callbacks.until_flat.patience=1", "callbacks.until_flat.margin=1.0"]
        job += ["callbacks.until_flat.lowerings=6", "scale.rounds=3"]
    else:
        job += ["scale.rounds=6"]
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert command("train", *job, f"paths.outputs={whole}").returncode == 0
    process = subprocess.Popen(
        [sys.executable, "-m", "imagination.train", *job, f"paths.outputs={broken}"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    last = Path(experiment) / "latest" / "checkpoints" / "last.ckpt"
    while not (broken / last).is_file():
        assert process.poll() is None
        time.sleep(0.02)
    time.sleep(moment)
    os.killpg(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    done = command("train", "resume=latest", f"paths.outputs={broken}")
    assert done.returncode == 0, done.stderr
    for name in ("mapping.csv", "runs.csv"):
        table = Path(experiment) / "latest" / "tables" / name
        assert (whole / table).read_bytes() == (broken / table).read_bytes()
    one, other = (read_state(outputs / last) for outputs in (whole, broken))
    assert one["epoch"] == other["epoch"] == 5
    assert all(torch.equal(one["state_dict"][name], other["state_dict"][name]) for name in one["state_dict"])
    assert one["optimizer_states"][0]["param_groups"] == other["optimizer_states"][0]["param_groups"]
    assert best_score(one) == best_score(other)


def best_score(state: dict[str, Any]) -> float:
    scores = [
        entry.get("best_model_score") for entry in state["callbacks"].values() if isinstance(entry, dict)
    ]
    return max(float(score) for score in scores if score is not None)
