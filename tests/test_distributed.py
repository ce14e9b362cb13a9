"""Two processes train as one: shared work, one folder, the same scores; one that dies stops the job, which goes on."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator, ScalarEvent

from imagination import ranks
from imagination.data.datamodule import SceneData
from imagination.data.replay_buffer import ReplayBuffer
from imagination.views.collector import Views, concatenate
from tests.conftest import ROOT, Command
from tests.data.test_collecting import data, same

JOB = ["+experiment=chair_unet", "scale=test", "scale.workers=0", "trainer.accelerator=cpu"]
TWO = [*JOB, "trainer.devices=2"]


def as_rank(number: int, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOCAL_RANK", str(number))
    monkeypatch.setenv("WORLD_SIZE", str(count))
    for module in ("data.datamodule", "callbacks.replay_buffer"):
        monkeypatch.setattr(f"imagination.{module}.ranks", lambda: count)


def test_each_process_has_scenes_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modules: list[SceneData] = []
    seen: list[set[str]] = []
    for number in (0, 1):
        as_rank(number, 2, monkeypatch)
        collector = data(tmp_path).collector(2)
        seen.append(set(collector.scenes))
        assert collector.views_per_collection == 4  # of 8 that both collect
        modules.append(data(tmp_path))
        assert set(ranks.begun_elsewhere(["a", "b", "c"])) == {"a", "b", "c"}
    assert not seen[0] & seen[1] and seen[0] | seen[1] == {"train_0", "train_1", "train_2"}
    assert ranks.begun_elsewhere(["a", "b", "c"])[0] == "b"


def test_held_out_views_are_shared_out_without_repetition(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = list(data(tmp_path).val_dataloader())  # 5 views and 2
    parts = []
    for number in (0, 1):
        as_rank(number, 2, monkeypatch)
        parts.append(list(data(tmp_path).val_dataloader()))
    for whole, one, other in zip(alone, *parts, strict=True):
        assert torch.equal(whole["depth"][0::2], one["depth"])
        assert torch.equal(whole["depth"][1::2], other["depth"])


def test_one_process_collects_as_before(tmp_path: Path) -> None:
    """What a process does alone is what it did before there were others: the first slot is 0."""
    collector = data(tmp_path).collector(2)
    assert collector.first_slot == 0 and collector.views_per_collection == 8
    views: list[Views] = [collector.start(index)() for index in (0, 1)]
    assert not same(*views)
    buffer = ReplayBuffer(16, 0.5)
    buffer.insert(concatenate(views))
    assert len(buffer.draw(8, np.random.default_rng(0))["pose"]) == 8


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["scale.batch_size=5"], "scale.batch_size: got 5 for 2 processes, expected a multiple of 2"),
        (["scale.homes.train=1"], "scale.homes.train: got 1 for 2 processes"),
        (["seed=1,2", "--multirun"], "trainer.devices: got 2 processes in a sweep"),
    ],
)
def test_what_cannot_be_shared_is_refused(command: Command, overrides: list[str], told: str) -> None:
    done = command("train", *TWO, *overrides)
    assert done.returncode != 0 and told in done.stderr and "Traceback" not in done.stderr, done.stderr


def test_several_processes_of_srun_are_refused(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """They would train apart from each other."""
    monkeypatch.setenv("SLURM_NTASKS", "2")
    done = command("train", *TWO)
    assert done.returncode == 2 and "expected torchrun as one task a host" in done.stderr


def events(folder: Path, tag: str) -> list[ScalarEvent]:
    read = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    read.Reload()
    return list(read.Scalars(tag))


def scalars(folder: Path, tag: str) -> list[float]:
    return [event.value for event in events(folder, tag)]


@pytest.mark.slow
def test_scores_are_those_of_one_process(command: Command, tmp_path: Path) -> None:
    """Two processes train and are tested; one process then tests the same checkpoint: the same tables and loss."""
    done = command("train", *TWO, "scale.held_out_views.test=11", timeout=1200)
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
def test_a_process_that_dies_stops_the_job_and_it_goes_on(
    command: Command, tmp_path: Path, victim: int
) -> None:
    long = ["scale.rounds=100000", "scale.eval_every=100000"]
    with open(tmp_path / "told", "w") as told:
        process = subprocess.Popen(
            [sys.executable, "-m", "imagination.train", *TWO, *long],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stderr=told,
        )
    last = tmp_path / "outputs" / "chair_unet" / "latest" / "checkpoints" / "last.ckpt"
    try:
        while not last.is_file():
            assert process.poll() is None, (tmp_path / "told").read_text()
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
    text = (tmp_path / "told").read_text()
    assert "another of the processes that train together is gone" in text, text
    assert f"ckpt_path={last.relative_to(tmp_path).parts[0]}" in text
    from imagination.checkpoints import Checkpoint, read_state

    rounds = read_state(last)["epoch"] + 1
    before = Checkpoint.read(last).record["samples"]
    done = command("train", *TWO, *long, "resume=latest", f"trainer.max_epochs={rounds + 1}", timeout=1200)
    assert done.returncode == 0, done.stderr
    assert read_state(last)["epoch"] == rounds
    # one more round and no other: the counts of those before it came out of the checkpoint
    assert Checkpoint.read(last).record["samples"] == before * (rounds + 1) // rounds
    steps = read_state(last)["global_step"]
    assert (
        steps * read_state(last)["imagination"]["values"]["scale"]["batch_size"]
        == before * (rounds + 1) // rounds
    )
    rounds_logged = [event.step for event in events(last.parent.parent, "train/waiting")]
    assert rounds_logged == sorted(set(rounds_logged)) and len(rounds_logged) == rounds + 1


def child_of(pid: int) -> int:
    """The process that Lightning started beside the first."""
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
