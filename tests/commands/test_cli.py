"""Commands as a user runs them: what a run leaves behind, and what mistakes get."""

import csv
import os
import signal
import subprocess
import sys
import time
from itertools import product
from pathlib import Path

import pytest
import torch

from imagination.config.compose import compose
from imagination.runs.preflight import gpu_memory
from imagination.utils.errors import UserError
from tests.conftest import ROOT, Command
from tests.runs.test_resume import points

EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))


ALIKE = "all_best", "all_shared", "bed_best", "table_best"
"""Experiments that are put together from what others run."""


@pytest.mark.parametrize(
    "experiment",
    [pytest.param(name, marks=pytest.mark.slow) if name in ALIKE else name for name in EXPERIMENTS],
)
def test_experiments_run_fast(command: Command, experiment: str) -> None:
    done = command("train", f"+experiment={experiment}", "scale=test", "trainer.fast_dev_run=true")
    assert done.returncode == 0, done.stderr


def test_a_whole_run(command: Command, tmp_path: Path) -> None:
    done = command("train", "+experiment=chair_unet", "scale=test")
    assert done.returncode == 0, done.stderr
    folders = [path for path in (tmp_path / "outputs" / "chair_unet").iterdir() if not path.is_symlink()]
    assert len(folders) == 1
    run = folders[0]
    assert (tmp_path / "outputs" / "chair_unet" / "latest").resolve() == run
    for name in (
        "config.yaml run.log tables/mapping.csv tables/mapping.md checkpoints/last.ckpt checkpoints/best.ckpt"
    ).split():
        assert (run / name).stat().st_size > 0, name
    assert "networks in 32-true" in (run / "tables" / "mapping.md").read_text()
    assert list(run.glob("figures/*.png"))
    shown = set(points(run / "tensorboard"))
    assert shown >= {f"train/{name}" for name in ("loss", "learning_rate", "samples_per_second")}
    assert shown >= {f"val/{name}" for name in ("loss", "iou", "precision", "recall")}
    assert shown >= {"global/chair/imagination/val", "global/chair/seg_gt/3m"}
    assert shown >= {"views/val", "maps/chair/val", "maps/chair/3m"}  # pictures
    assert "tensorboard --logdir outputs/chair_unet" in done.stderr
    assert all(
        share in done.stderr for share in ("scenes and truth", "training", "evaluation", "Peak memory")
    )
    again = next(line for line in done.stderr.splitlines() if line.startswith("Evaluate again: "))
    assert "=" not in again.partition("ckpt=")[2]
    done = command(*again.partition("imagination.")[2].split())
    assert done.returncode == 0, done.stderr
    evaluated = next(run.parent.glob("evaluate_*"))
    for table in ("mapping.csv", "paired.csv", "trials.csv"):
        assert (evaluated / "tables" / table).read_bytes() == (run / "tables" / table).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["+experiment=chair_unt"], ["Could not find 'experiment/chair_unt'", "chair_unet", "bed_unet"]),
        (["scale=huge"], ["desk", "paper", "test"]),
        (["model/encoder=foo"], ["resnet18", "timm"]),
        (["unit_categories=[sofa]"], ["got 'sofa', expected one of: bed, chair, table"]),
        (["kernels.imaginable=-1"], ["kernels.imaginable: got -1"]),
        (["kernel.imaginable=1"], ["Key 'kernel' is not in struct"]),
        (["resume=latest"], ["found no run of any experiment"]),
        (["ckpt_path=nothing.ckpt"], ["got nothing.ckpt, but there is no such file"]),
        (["scale=test", "model/encoder=timm"], ["Missing mandatory value"]),
    ],
)
def test_mistakes_get_one_message(
    command: Command, tmp_path: Path, arguments: list[str], told: list[str]
) -> None:
    done = command("train", *arguments)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if not line.startswith("\t")]  # of what exists
    assert lines[0].startswith("error: ") and len(lines) < 12
    assert all(text in done.stderr for text in told), done.stderr
    assert not (tmp_path / "outputs").exists()


def test_a_mistake_found_later_is_told_as_shortly(command: Command, tmp_path: Path) -> None:
    done = command("train", "scale=test", "model/encoder=timm", "model.encoder.name=resnet1888")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr and "resnet18" in done.stderr
    runs = tmp_path / "outputs" / "custom"
    assert "Traceback" in only(runs, "*/run.log").read_text()
    assert not (runs / "latest").is_symlink()  # it was refused: there is nothing to go on with


def test_an_accelerator_that_is_not_there_is_told(command: Command) -> None:
    done = command("train", "scale=test", "trainer.accelerator=tpu")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "trainer.accelerator: got 'tpu', expected one that this machine has: auto, cpu" in done.stderr


@pytest.mark.slow
def test_a_killed_worker_is_told_and_the_run_goes_on(command: Command, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "imagination.train", "scale=test", "scale.workers=2", "scale.epochs=500"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        while not list(tmp_path.glob("outputs/custom/*/checkpoints/last.ckpt")):
            assert process.poll() is None
            time.sleep(0.1)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        worker = next(pid for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes())
        os.kill(int(worker), signal.SIGKILL)
        told = process.communicate(timeout=120)[1]
    finally:
        process.kill()
    assert process.returncode == 2 and "Traceback" not in told, told
    assert "take fewer with scale.workers; go on with the same command and ckpt_path=outputs/custom/" in told
    last = only(tmp_path, "outputs/custom/2*/checkpoints/last.ckpt")
    epochs = torch.load(last, weights_only=True)["epoch"] + 3
    done = command("train", f"ckpt_path={last}", "scale.workers=0", f"trainer.max_epochs={epochs}")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (
            ["scale.accumulate=2", "scale.precision=32-true"],
            "scale.accumulate=4, .* scale.precision=bf16-mixed",
        ),
        (["+experiment=segmentation_hrnet", "scale.hrnet_accumulate=6"], "scale.hrnet_accumulate=12, "),
        (["scale.accumulate=80", "trainer.precision=bf16-mixed"], "scale.accumulate=108, .*, or a GPU"),
        (["scale.accumulate=108", "trainer.precision=bf16-mixed"], "expected a new run with a GPU"),
    ],
)
def test_a_gpu_that_is_too_small_is_told(overrides: list[str], told: str) -> None:
    config = compose("train", ["scale=paper", "paths.run=.", *overrides])
    told = rf"with 108 views a GPU in \d+ part.* {told}.* CUDA out of memory\. .* is free\.$"
    with pytest.raises(UserError, match=told), gpu_memory(config):
        raise torch.OutOfMemoryError(
            "CUDA out of memory. Tried to allocate 324.00 MiB. GPU 0 has a total capacity of 79.18 GiB of which "
            "268.19 MiB is free. Including non-PyTorch memory, this process has 78.91 GiB memory in use."
        )


def only(folder: Path, pattern: str) -> Path:
    (path,) = folder.glob(pattern)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", ["train", "render"])
def test_ctrl_c_while_homes_are_built(tmp_path: Path, name: str) -> None:
    """To the whole group, as a terminal sends it: a message and nothing else, within seconds."""
    arguments = ["scale.scenes.train=40", "scale.gt_image=512", "scale.resolution=0.03", "scale.workers=2"]
    process = subprocess.Popen(
        [sys.executable, "-m", f"imagination.{name}", "scale=test", *arguments],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        if name == "train":
            while not list(tmp_path.glob("outputs/custom/*/run.log")):
                assert process.poll() is None
                time.sleep(0.1)
        time.sleep(12)
        assert process.poll() is None
        start = time.monotonic()
        os.killpg(process.pid, signal.SIGINT)
        told = process.communicate(timeout=60)[1]
        seconds = time.monotonic() - start
    finally:
        process.kill()
    assert process.returncode == 130
    assert "Interrupted" in told and "Traceback" not in told, told
    assert seconds < 5, f"took {seconds:.1f} s"


def test_ctrl_c_says_how_to_go_on(tmp_path: Path) -> None:
    arguments = ["+experiment=chair_unet", "scale=test", "scale.epochs=10000", "scale.eval_every=10000"]
    with open(tmp_path / "told", "w") as told:
        process = subprocess.Popen(
            [sys.executable, "-m", "imagination.train", *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stderr=told,
        )
        try:
            last = tmp_path / "outputs" / "chair_unet" / "latest" / "checkpoints" / "last.ckpt"
            while not last.is_file():
                assert process.poll() is None, (tmp_path / "told").read_text()
                time.sleep(0.1)
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 130
        finally:
            process.kill()
    text = (tmp_path / "told").read_text()
    assert "Traceback" not in text
    assert "Interrupted. Go on with: python -m imagination.train ckpt_path=outputs/chair_unet/" in text


def test_an_evaluation_of_no_checkpoint_is_told(command: Command) -> None:
    done = command("evaluate", "ckpt=[]")
    assert done.returncode == 2 and done.stderr.startswith("error: ckpt: got none"), done.stderr


@pytest.mark.slow
def test_the_study_runs_and_does_nothing_twice(command: Command, tmp_path: Path) -> None:
    arguments = ["study", "scale=test", "experiments=[chair_unet,bed_unet,segmentation_hrnet]"]
    done = command(*arguments, timeout=900)
    assert done.returncode == 0, done.stderr
    again = command(*arguments, timeout=900)
    assert again.returncode == 0, again.stderr
    assert again.stderr.count("already trained") == 3 and "training epochs" not in again.stderr
    tables = [path / "tables" for path in sorted((tmp_path / "outputs" / "study").glob("evaluate_*"))]
    assert len(tables) == 2
    for name in ("mapping.csv", "paired.csv", "trials.csv", "training.csv", "furniture.csv"):
        assert (tables[0] / name).read_bytes() == (tables[1] / name).read_bytes()
    rows = list(csv.DictReader((tables[0] / "mapping.csv").read_text().splitlines()))
    approaches = {
        "seg_gt", "seg_hrnet", "imagination_seen", "seen_dilated", "imagination", "imagination_dilated",
        "rgb_shuffled", "oracle",
    }  # fmt: skip
    assert {(row["approach"], row["category"], row["cell_width"]) for row in rows} == set(
        product(approaches, ["chair", "bed"], ["3", "2.5"])
    )
    training = list(csv.DictReader((tables[0] / "training.csv").read_text().splitlines()))
    views = {row["network"]: row["views"] for row in training}
    assert views["segmentation_hrnet"] == views["chair_unet"]  # as many as the units had
    samples = {row["network"]: int(row["samples"]) for row in training}
    assert samples["segmentation_hrnet"] >= samples["chair_unet"]


@pytest.mark.slow
def test_the_papers_scale_takes_its_first_steps_on_a_cpu(command: Command, tmp_path: Path) -> None:
    """With all its numbers but the batch's size and how many scenes there are; then one viewpoint set."""
    fewer = ["scale.scenes={train:1,val:1,test:1}", "scale.batch_size=2", "evaluation.viewpoint_sets=1"]
    steps = ["+experiment=chair_unet", "scale=paper", *fewer, "trainer.fast_dev_run=2"]
    done = command("train", *steps, timeout=3000)
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader(only(tmp_path / "outputs", "**/mapping.csv").read_text().splitlines()))
    assert {(row["cell_width"], row["runs"]) for row in rows} == {("3", "1"), ("2.5", "1"), ("2", "1")}
    assert all(int(row["gt_pixels"]) > 0 for row in rows)


@pytest.mark.slow
def test_a_wheel_runs_elsewhere(tmp_path: Path) -> None:
    """The package with its conf, away from the checkout: outputs go under the current folder."""
    site, here = tmp_path / "site", tmp_path / "here"
    here.mkdir()
    install = "-m pip install --quiet --no-deps --no-build-isolation --no-index --target".split()
    subprocess.run([sys.executable, *install, str(site), str(ROOT)], check=True, timeout=300)
    code = "import imagination, sys; sys.exit(not imagination.__file__.startswith(sys.argv[1]))"
    environment = os.environ | {"PYTHONPATH": str(site)}
    subprocess.run([sys.executable, "-c", code, str(site)], cwd=here, env=environment, check=True)
    job = [sys.executable, "-m", "imagination.train", "+experiment=chair_unet", "scale=test"]
    subprocess.run(job, cwd=here, env=environment, check=True, timeout=300)
    assert (here / "outputs" / "chair_unet" / "latest" / "tables" / "mapping.csv").is_file()
