"""Distributed training: split work, one run folder, the same scores; a lost process stops the job, which resumes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning import Trainer
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator, ScalarEvent

from imagination.data.datamodule import SceneData
from imagination.data.replay_buffer import ReplayBuffer
from imagination.runs import resume
from imagination.runs.checkpoint import Checkpoint, read_state
from imagination.runs.distributed import cluster_environment
from imagination.runs.resume import lost_process_error
from imagination.utils.process_group import rotated_by_rank
from imagination.views.collector import Views, concatenate
from tests.conftest import ROOT, Command
from tests.data.test_datamodule import data, same

JOB = ["+experiment=chair_unet", "scale=test", "data.workers=0", "trainer.accelerator=cpu"]
TWO = [*JOB, "trainer.devices=2"]


def as_rank(number: int, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOCAL_RANK", str(number))
    monkeypatch.setenv("WORLD_SIZE", str(count))
    for module in ("data.datamodule", "data.collection", "data.batches"):
        monkeypatch.setattr(f"imagination.{module}.world_size", lambda: count)


def test_processes_have_different_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modules: list[SceneData] = []
    seen: list[set[str]] = []
    for number in (0, 1):
        as_rank(number, 2, monkeypatch)
        collector = data(tmp_path).collector(2)
        seen.append(set(collector.scenes))
        assert collector.views_per_collection == 4  # of 8 that both collect
        modules.append(data(tmp_path))
        assert set(rotated_by_rank(["a", "b", "c"])) == {"a", "b", "c"}
    assert not seen[0] & seen[1] and seen[0] | seen[1] == {"train_0", "train_1", "train_2"}
    assert rotated_by_rank(["a", "b", "c"])[0] == "b"


def test_eval_views_are_split_without_overlap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = list(data(tmp_path).val_dataloader())  # 7 views in batches of 3 or more
    for number in (0, 1, 2):
        as_rank(number, 3, monkeypatch)
        for whole, part in zip(alone, data(tmp_path).val_dataloader(), strict=True):
            assert len(part["depth"]) and torch.equal(whole["depth"][number::3], part["depth"])


def test_one_process_collects_as_before(tmp_path: Path) -> None:
    collector = data(tmp_path).collector(2)
    assert collector.first_slot == 0 and collector.views_per_collection == 8
    views: list[Views] = [collector.start(index)() for index in (0, 1)]
    assert not same(*views)
    buffer = ReplayBuffer(16, 0.5)
    buffer.insert(concatenate(views))
    assert len(buffer.draw(8, np.random.default_rng(0))["pose"]) == 8


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["data.batch_size=5"], "data.batch_size: got 5 "),
        (["data.splits.train=1"], "data.splits.train: got 1 "),
        (["data.eval_views.val=1"], "data.eval_views.val: got 1 "),
        pytest.param(["seed=1,2", "--multirun"], "trainer.devices: got 2 ", marks=pytest.mark.slow),
    ],
)
def test_sizes_that_cannot_be_split_are_refused(
    command_in_process: Command, overrides: list[str], message: str
) -> None:
    done = command_in_process("train", *TWO, *overrides)
    assert done.returncode != 0 and message in done.stderr and "Traceback" not in done.stderr, done.stderr


def in_slurm(monkeypatch: pytest.MonkeyPatch, **variables: int) -> None:
    for name, number in {"JOB_ID": 7, **variables}.items():
        monkeypatch.setenv(f"SLURM_{name}", str(number))


@pytest.mark.parametrize("job", [JOB, TWO])
def test_several_tasks_of_srun_are_refused(
    command_in_process: Command, monkeypatch: pytest.MonkeyPatch, job: list[str]
) -> None:
    """The tasks would train independently."""
    in_slurm(monkeypatch, NTASKS=4, STEP_NUM_TASKS=4, PROCID=2, LOCALID=2, NODEID=0)
    done = command_in_process("train", *job)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "srun: got 4 tasks" in done.stderr


def test_several_hosts_without_torchrun_are_refused(command_in_process: Command) -> None:
    done = command_in_process("train", *JOB, "trainer.num_nodes=2")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "trainer.num_nodes: got 2 " in done.stderr


@pytest.mark.parametrize("devices", [1, 2])
def test_a_process_in_a_slurm_job_is_the_first(monkeypatch: pytest.MonkeyPatch, devices: int) -> None:
    """Otherwise a process with another SLURM task number, such as a Ray worker, would log nothing."""
    in_slurm(monkeypatch, NTASKS=4, PROCID=3, LOCALID=3, NODEID=1)
    monkeypatch.setattr(rank_zero_only, "rank", 3)  # the rank that Lightning derives from these variables
    trainer = Trainer(accelerator="cpu", devices=devices, logger=False, plugins=[cluster_environment()])
    assert trainer.is_global_zero and trainer.world_size == devices and rank_zero_only.rank == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "place", [{"NTASKS": 4, "PROCID": 0}, {"NTASKS": 2, "NTASKS_PER_NODE": 1, "PROCID": 1}]
)
def test_one_process_in_a_slurm_job_trains(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: dict[str, int]
) -> None:
    """A batch script, and a process that was started by another task."""
    in_slurm(monkeypatch, **place, LOCALID=0, NODEID=place["PROCID"])
    done = command("train", *JOB, timeout=600)
    assert done.returncode == 0, done.stderr
    assert scalars(tmp_path / "outputs" / "chair_unet" / "latest", "test/loss")


def test_the_error_of_a_lost_process_names_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resume, "changes_of_this_command", list)  # no command is running
    assert f"imagination.train resume={tmp_path}" in str(lost_process_error(tmp_path))


def events(folder: Path, tag: str) -> list[ScalarEvent]:
    read = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    read.Reload()
    return list(read.Scalars(tag))


def scalars(folder: Path, tag: str) -> list[float]:
    return [event.value for event in events(folder, tag)]


@pytest.mark.slow
def test_scores_are_those_of_one_process(command: Command, tmp_path: Path) -> None:
    """Two processes train and are tested; one process then tests the same checkpoint: the same tables and loss."""
    views = "data.eval_views={val: 9, test: 9}"  # in batches of 4: one view remains
    done = command("train", *TWO, views, timeout=1200)
    assert done.returncode == 0, done.stderr
    folders = [path for path in (tmp_path / "outputs" / "chair_unet").iterdir() if not path.is_symlink()]
    assert len(folders) == 1
    tables = {path.name: path.read_bytes() for path in (folders[0] / "tables").glob("*.csv")}
    assert {"ego.csv", "mapping.csv"} <= set(tables)
    together = scalars(folders[0], "test/loss")[-1]
    done = command("train", "resume=latest", "trainer.devices=1", timeout=1200)
    assert done.returncode == 0, done.stderr
    assert {name: (folders[0] / "tables" / name).read_bytes() for name in tables} == tables
    alone = scalars(folders[0], "test/loss")[-1]
    assert together == pytest.approx(alone, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_process_stops_the_job_which_resumes(command: Command, tmp_path: Path, victim: int) -> None:
    long = ["trainer.max_epochs=100000", "trainer.check_val_every_n_epoch=100000"]
    with open(tmp_path / "stderr", "w") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "imagination.train", *TWO, *long],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stderr=stderr,
        )
    last = tmp_path / "outputs" / "chair_unet" / "latest" / "checkpoints" / "last.ckpt"
    try:
        while not last.is_file():
            assert process.poll() is None, (tmp_path / "stderr").read_text()
            time.sleep(0.1)
        other = child_of(process.pid)
        os.kill((process.pid, other)[victim], signal.SIGKILL)
        assert process.wait(300) != 0
        end = time.monotonic() + 300
        while Path(f"/proc/{other}").exists() and time.monotonic() < end:
            time.sleep(0.1)
        assert not Path(f"/proc/{other}").exists()
    finally:
        process.kill()
    text = (tmp_path / "stderr").read_text()
    assert "another training process has ended" in text, text
    assert "imagination.train resume=outputs/chair_unet/" in text
    epochs = read_state(last)["epoch"] + 1
    before = Checkpoint.read(last).training_stats["samples"]
    done = command("train", *TWO, *long, "resume=latest", f"trainer.max_epochs={epochs + 1}", timeout=1200)
    assert done.returncode == 0, done.stderr
    assert read_state(last)["epoch"] == epochs
    # exactly one more epoch: the counts of the earlier epochs come from the checkpoint
    assert Checkpoint.read(last).training_stats["samples"] == before * (epochs + 1) // epochs
    steps = read_state(last)["global_step"]
    assert (
        steps * read_state(last)["imagination"]["values"]["data"]["batch_size"]
        == before * (epochs + 1) // epochs
    )
    epochs_logged = [event.step for event in events(last.parent.parent, "train/waiting")]
    assert epochs_logged == sorted(set(epochs_logged)) and len(epochs_logged) == epochs + 1


def child_of(pid: int) -> int:
    """Return the id of the process that Lightning started from rank 0."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            words = (folder / "cmdline").read_bytes()
        except OSError:
            continue
        if parent == pid and b"train_ddp_process_1" in words:
            return int(folder.name)
    raise AssertionError("the second process was not found")


@pytest.mark.slow
def test_torchrun_starts_them_all(tmp_path: Path) -> None:
    words = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m", "imagination.train"]
    done = subprocess.run(
        [sys.executable, *words, *TWO],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=1200,
    )
    assert done.returncode == 0, done.stderr
    folders = [path for path in (tmp_path / "outputs" / "chair_unet").iterdir() if not path.is_symlink()]
    assert len(folders) == 1 and (folders[0] / "tables" / "mapping.csv").is_file()
