"""Commands as a user runs them: results of a run and messages of user errors."""

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
from imagination.runs.preflight import out_of_memory_reported
from imagination.utils.errors import UserError
from tests.conftest import ROOT, Command
from tests.reference.results import check_table
from tests.runs.test_resume import points

EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))


@pytest.mark.slow  # test_a_whole_run, and the tests of units and segmentation networks, cover the parts
@pytest.mark.parametrize("experiment", EXPERIMENTS)
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
    check_table(run / "tables" / "mapping.csv", "chair_unet")
    assert list(run.glob("figures/*.png"))
    shown = set(points(run / "tensorboard"))
    assert shown >= {"train/loss", "train/samples_per_second", "lr"}
    assert shown >= {f"val/{name}" for name in ("loss", "iou", "precision", "recall")}
    assert shown >= {"global/chair/imagination/val", "global/chair/seg_gt/3m"}
    assert shown >= {"views/val", "maps/chair/val", "maps/chair/3m"}  # images
    assert "tensorboard --logdir outputs/chair_unet" in done.stderr
    assert all(
        name in done.stderr for name in ("scenes and ground truth", "training", "evaluation", "Peak memory")
    )
    line = next(line for line in done.stderr.splitlines() if "imagination.evaluate" in line)
    assert "=" not in line.partition("ckpt=")[2]
    done = command(*line.partition("imagination.")[2].split())
    assert done.returncode == 0, done.stderr
    evaluated = next(run.parent.glob("evaluate_*"))
    for table in ("tables/mapping.csv", "tables/paired.csv", "records/trials.csv"):
        assert (evaluated / table).read_bytes() == (run / table).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["+experiment=chair_unt"], ["experiment: got 'chair_unt'", "chair_unet", "bed_unet"]),
        (["scale=huge"], ["small", "paper", "test"]),
        (["model/encoder=foo"], ["resnet18", "timm"]),
        (["unit_categories=[sofa]"], ["got 'sofa'", "bed, chair, table"]),
        (["kernels.imaginable=-1"], ["kernels.imaginable: got -1"]),
        (["kernel.imaginable=1"], ["kernel.imaginable: got", "kernels.imaginable"]),
        (["resume=latest"], ["resume=latest: "]),
        (["ckpt_path=nothing.ckpt"], ["ckpt_path: got nothing.ckpt"]),
        (["scale=test", "model/encoder=timm"], ["Missing mandatory value"]),
    ],
)
def test_user_errors_get_one_message(
    command_in_process: Command, tmp_path: Path, arguments: list[str], messages: list[str]
) -> None:
    done = command_in_process("train", *arguments)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    lines = [
        line for line in done.stderr.splitlines() if not line.startswith("\t")
    ]  # of the existing options
    assert lines[0].startswith("error: ") and len(lines) < 12
    assert all(text in done.stderr for text in messages), done.stderr
    assert not (tmp_path / "outputs").exists()


def test_a_user_error_after_the_start_gets_one_message(command_in_process: Command, tmp_path: Path) -> None:
    done = command_in_process("train", "scale=test", "model/encoder=timm", "model.encoder.name=resnet1888")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr and "resnet18" in done.stderr
    runs = tmp_path / "outputs" / "custom"
    assert "Traceback" in only(runs, "*/run.log").read_text()
    assert not (runs / "latest").is_symlink()  # the run was refused: there is nothing to resume


def test_a_missing_accelerator_is_refused(command_in_process: Command) -> None:
    done = command_in_process("train", "scale=test", "trainer.accelerator=tpu")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "trainer.accelerator: got 'tpu'" in done.stderr and "auto, cpu" in done.stderr


@pytest.mark.slow
def test_a_killed_worker_is_reported_and_the_run_resumes(command: Command, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "imagination.train", "scale=test", "data.workers=2", "trainer.max_epochs=500"],
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
        stderr = process.communicate(timeout=120)[1]
    finally:
        process.kill()
    assert process.returncode == 2 and "Traceback" not in stderr, stderr
    assert "data.workers" in stderr and "imagination.train resume=outputs/custom/" in stderr, stderr
    last = only(tmp_path, "outputs/custom/2*/checkpoints/last.ckpt")
    epochs = torch.load(last, weights_only=True)["epoch"] + 3
    done = command("train", f"ckpt_path={last}", "data.workers=0", f"trainer.max_epochs={epochs}")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("overrides", "advice"),
    [
        (
            ["data.micro_batches=2", "trainer.precision=32-true"],
            "data.micro_batches=4, .* trainer.precision=bf16-mixed",
        ),
        (["+experiment=segmentation_hrnet", "data.micro_batches=6"], "data.micro_batches=12, "),
        (["data.micro_batches=80", "trainer.precision=bf16-mixed"], "data.micro_batches=108, .* a GPU"),
        (["data.micro_batches=108", "trainer.precision=bf16-mixed"], "a new run with a GPU"),
    ],
)
def test_advice_for_a_gpu_that_is_too_small(overrides: list[str], advice: str) -> None:
    config = compose("train", ["scale=paper", "paths.run=.", *overrides])
    message = rf"GPU memory: .*108 views.* \d+ part.* {advice}.* CUDA out of memory\. .* is free\.$"
    with pytest.raises(UserError, match=message), out_of_memory_reported(config):
        raise torch.OutOfMemoryError(
            "CUDA out of memory. Tried to allocate 324.00 MiB. GPU 0 has a total capacity of 79.18 GiB of which "
            "268.19 MiB is free. Including non-PyTorch memory, this process has 78.91 GiB memory in use."
        )


def only(folder: Path, pattern: str) -> Path:
    (path,) = folder.glob(pattern)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", ["train", "render"])
def test_ctrl_c_while_scenes_are_built(tmp_path: Path, name: str) -> None:
    """SIGINT to the process group, as from a terminal: one message within seconds."""
    arguments = [
        "data.splits.train=40",
        "ground_truth.camera.width=512",
        "ego.resolution=0.03",
        "data.workers=2",
    ]
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
        stderr = process.communicate(timeout=60)[1]
        seconds = time.monotonic() - start
    finally:
        process.kill()
    assert process.returncode == 130
    assert "Interrupted" in stderr and "Traceback" not in stderr, stderr
    assert seconds < 5, f"took {seconds:.1f} s"


@pytest.mark.slow
def test_a_terminated_run_reports_how_to_resume(tmp_path: Path) -> None:
    long = ["trainer.max_epochs=10000", "trainer.check_val_every_n_epoch=10000"]
    arguments = ["+experiment=chair_unet", "scale=test", *long]
    with open(tmp_path / "stderr", "w") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "imagination.train", *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stderr=stderr,
        )
        try:
            last = tmp_path / "outputs" / "chair_unet" / "latest" / "checkpoints" / "last.ckpt"
            while not last.is_file():
                assert process.poll() is None, (tmp_path / "stderr").read_text()
                time.sleep(0.1)
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 143
        finally:
            process.kill()
    text = (tmp_path / "stderr").read_text()
    assert "Traceback" not in text
    assert "Interrupted" in text and "imagination.train resume=outputs/chair_unet/" in text


def test_an_evaluation_without_a_checkpoint_is_refused(command_in_process: Command) -> None:
    done = command_in_process("evaluate", "ckpt=[]")
    assert done.returncode == 2 and done.stderr.startswith("error: ckpt: got none"), done.stderr


@pytest.mark.slow
def test_the_study_reuses_finished_runs(command: Command, tmp_path: Path) -> None:
    arguments = ["study", "scale=test", "experiments=[chair_unet,bed_unet,segmentation_hrnet]"]
    done = command(*arguments, timeout=900)
    assert done.returncode == 0, done.stderr
    second = command(*arguments, timeout=900)
    assert second.returncode == 0, second.stderr
    assert second.stderr.count("already trained") == 3 and "training epochs" not in second.stderr
    tables = [path / "tables" for path in sorted((tmp_path / "outputs" / "study").glob("2*"))]
    assert len(tables) == 2
    for name in ("mapping.csv", "paired.csv", "mapping_details.csv", "training.csv", "furniture.csv"):
        assert (tables[0] / name).read_bytes() == (tables[1] / name).read_bytes()
    rows = list(csv.DictReader((tables[0] / "mapping.csv").read_text().splitlines()))
    approaches = {
        "seg_gt", "seg_hrnet", "imagination_seen", "seen_dilated", "imagination",
        "rgb_shuffled", "oracle",
    }  # fmt: skip
    assert {(row["approach"], row["category"], row["cell_width"]) for row in rows} == set(
        product(approaches, ["chair", "bed"], ["3", "2.5"])
    )
    training = list(csv.DictReader((tables[0] / "training.csv").read_text().splitlines()))
    views = {row["network"]: row["views"] for row in training}
    assert views["segmentation_hrnet"] == views["chair_unet"]  # as many as for the units
    samples = {row["network"]: int(row["samples"]) for row in training}
    assert samples["segmentation_hrnet"] >= samples["chair_unet"]


@pytest.mark.slow
def test_first_steps_at_paper_scale_on_a_cpu(command: Command, tmp_path: Path) -> None:
    """All values of the paper but the batch size and the number of scenes; one viewpoint set."""
    fewer = ["data.splits={train:1,val:1,test:1}", "data.batch_size=2", "evaluation.viewpoint_sets=1"]
    steps = ["+experiment=chair_unet", "scale=paper", *fewer, "trainer.fast_dev_run=2"]
    done = command("train", *steps, timeout=3000)
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader(only(tmp_path / "outputs", "**/mapping.csv").read_text().splitlines()))
    assert {(row["cell_width"], row["trials"]) for row in rows} == {("3", "1"), ("2.5", "1"), ("2", "1")}
    assert all(int(row["gt_pixels"]) > 0 for row in rows)


@pytest.mark.slow
def test_an_installed_wheel_runs(tmp_path: Path) -> None:
    """The wheel contains conf and the template of plugins; outputs are written to the current folder."""
    site, work = tmp_path / "site", tmp_path / "work"
    work.mkdir()
    install = "-m pip install --quiet --no-deps --no-build-isolation --no-index --target".split()
    subprocess.run([sys.executable, *install, str(site), str(ROOT)], check=True, timeout=300)
    code = "import imagination, sys; sys.exit(not imagination.__file__.startswith(sys.argv[1]))"
    environment = os.environ | {"PYTHONPATH": str(site)}
    subprocess.run([sys.executable, "-c", code, str(site)], cwd=work, env=environment, check=True)
    job = [sys.executable, "-m", "imagination.train", "+experiment=chair_unet", "scale=test"]
    subprocess.run(job, cwd=work, env=environment, check=True, timeout=300)
    assert (work / "outputs" / "chair_unet" / "latest" / "tables" / "mapping.csv").is_file()
    job = [sys.executable, "-m", "imagination.plugins", "new=mine"]
    subprocess.run(job, cwd=work, env=environment, check=True, timeout=60)
    assert (work / "plugins" / "mine" / "imagination_mine" / "losses.py").is_file()
