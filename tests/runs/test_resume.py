"""Resuming of runs, checkpoints, and refusal of code in untrusted files."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.callbacks.model_checkpoint import MovableCheckpoint
from imagination.config.compose import compose
from imagination.evaluation.checkpoint_config import evaluation_config
from imagination.models.encoders import create
from imagination.models.schedulers import CosineAnnealing
from imagination.runs.checkpoint import KEY, Checkpoint, CheckpointFiles, hyperparameters, read_state
from imagination.runs.folder import LAST, create_folder, point_latest, restore_latest
from imagination.utils.errors import UserError
from tests.conftest import ROOT, Command

JOB = ["+experiment=chair_unet", "scale=test"]
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))


def config(*overrides: str) -> DictConfig:
    scale = [] if any(text.startswith("scale=") for text in overrides) else JOB[1:]
    composed = compose("train", [JOB[0], *scale, *overrides, "paths.run=."])
    composed.choices = JOB
    return composed


def checkpoint(path: Path, saved_config: dict[str, Any] | None = None) -> Path:
    """Write a checkpoint of an untrained unit, with its own or a given saved config."""
    whole = config("seed=7", "model.loss.alpha_max=12.0")
    state = {"state_dict": instantiate(whole.model.module).state_dict()}
    CheckpointFiles().save_checkpoint({**state, KEY: saved_config or hyperparameters(whole)}, path)
    return path


def test_a_checkpoint_holds_values_and_no_targets(tmp_path: Path) -> None:
    state = read_state(checkpoint(tmp_path / "a.ckpt"))
    assert "_target_" not in str(state[KEY]) and str(Path.cwd()) not in str(state[KEY])
    read = Checkpoint.read(tmp_path / "a.ckpt")
    assert (read.config.seed, read.config.model.loss.alpha_max, read.config.model.width) == (
        7,
        12.0,
        4,
    )
    assert read.config.model.unit._target_ == "imagination.models.imagination_unit.ImaginationUnit"
    assert read.model().loss.alpha_max == 12.0
    read.check_compatible(config())
    with pytest.raises(UserError, match=r"chair .*0\.12 m.* chair .*0\.06 m"):
        read.check_compatible(config("scale=small"))


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
def test_an_untrusted_checkpoint_names_no_code(
    tmp_path: Path, choices: list[str], values: dict[str, Any]
) -> None:
    path = checkpoint(tmp_path / "a.ckpt", {"choices": choices, "values": values})
    with pytest.raises(UserError, match="checkpoint .*holds"):
        Checkpoint.read(path).model()


@pytest.mark.parametrize(
    "override",
    [
        "paths.cache=/victim",
        "cache={folder: /victim, max_gigabytes: 0.001}",
        "cache.max_gigabytes=0.001",
        "data.observer.cache.folder=/victim",
        "data={observer: {cache: {folder: /victim}}}",
        "data.module.shard_cache=/victim",
        "callbacks.mapping_evaluation.folder=/victim",
        "+callbacks.last_checkpoint.dirpath=/victim",
        "logger.tensorboard.save_dir=/victim",
        "trainer.devices=8",
        "trainer.default_root_dir=/victim",
        "hydra/launcher=joblib",
        "hydra.run.dir=/victim",
        "sweep=weights",
    ],
)
def test_a_checkpoint_sets_only_keys_of_the_training_and_the_evaluation(
    tmp_path: Path, override: str
) -> None:
    path = checkpoint(tmp_path / "best.ckpt")
    state = read_state(path)
    state[KEY]["choices"].append(override)
    torch.save(state, path)
    for read in (
        lambda: Checkpoint.read(path).config,
        lambda: evaluation_config([Checkpoint.read(path)], []),
    ):
        with pytest.raises(UserError) as error:
            read()
        assert override in str(error.value) and str(path) in str(error.value)


def test_values_of_a_checkpoint_set_no_paths(tmp_path: Path) -> None:
    path = checkpoint(tmp_path / "best.ckpt")
    expected = Checkpoint.read(path).config
    state = read_state(path)
    cache = {"folder": "/victim", "max_gigabytes": 0.001}
    values = state[KEY]["values"]
    values["paths"] = {"outputs": "/victim", "cache": "/victim", "run": "/victim"}
    values["cache"] = values["data"]["observer"]["cache"] = values["data"]["module"]["observer"]["cache"] = (
        cache
    )
    values["callbacks"]["mapping_evaluation"]["folder"] = values["trainer"]["default_root_dir"] = "/victim"
    values["trainer"]["devices"] = 64
    values["model"]["width"] = 8
    torch.save(state, path)
    read = Checkpoint.read(path).config
    assert "/victim" not in OmegaConf.to_yaml(read)
    assert read.trainer.devices == 1 and read.cache == expected.cache
    assert read.model.width == read.model.backbone.width == 8  # a value of the training is taken


def test_a_checkpoint_of_pretrained_weights_needs_no_download(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = config()
    state = {"state_dict": instantiate(whole.model.module).state_dict()}
    whole.model.encoder.pretrained = True
    CheckpointFiles().save_checkpoint({**state, KEY: hyperparameters(whole)}, tmp_path / "a.ckpt")
    requested = []
    monkeypatch.setattr(
        "imagination.models.encoders.create",
        lambda name, pretrained, options: requested.append(pretrained) or create(name, False, options),
    )
    assert Checkpoint.read(tmp_path / "a.ckpt").config.model.encoder.pretrained
    Checkpoint.read(tmp_path / "a.ckpt").model()
    assert requested and not any(requested)


def test_damaged_checkpoints_are_refused(tmp_path: Path) -> None:
    path = checkpoint(tmp_path / "a.ckpt")
    content = path.read_bytes()
    for end in (0, 10, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:end])
        with pytest.raises(UserError, match="a.ckpt: cannot be read"):
            Checkpoint.read(path)
    torch.save({"x": 1}, path)
    with pytest.raises(UserError, match="a.ckpt: was not written"):
        Checkpoint.read(path)
    torch.save({"x": subprocess.Popen}, path)  # not plain data
    with pytest.raises(UserError, match="a.ckpt: cannot be read"):
        Checkpoint.read(path)
    with pytest.raises(UserError, match="got .*b.ckpt"):
        Checkpoint.read(tmp_path / "b.ckpt")


def test_a_checkpoint_of_another_model_is_refused(tmp_path: Path) -> None:
    values = hyperparameters(config())["values"]
    values["model"]["width"] = 8
    for unit in (values["model"]["unit"], values["model"]["module"]["unit"]):
        unit["backbone"]["width"] = 8
    path = checkpoint(tmp_path / "a.ckpt", {"choices": JOB, "values": values})
    with pytest.raises(UserError, match=r"a\.ckpt: .*weights.* [\w.]+: got \(\d.*?\), expected \(\d"):
        Checkpoint.read(path).model()


@pytest.mark.slow
def test_a_resumed_run_keeps_its_config(
    command: Command, command_in_process: Command, tmp_path: Path
) -> None:
    assert command("train", *JOB, "seed=3", "trainer.max_epochs=1", "test=false").returncode == 0
    for refused in ("seed=4", "scale=small", "model=projected"):
        done = command_in_process("train", "resume=latest", refused)
        assert done.returncode == 2 and f"resume: got {refused}" in done.stderr
    # equal overrides are allowed, as for a cluster job that is started again
    done = command(
        "train", *JOB, "seed=3", "resume=latest", "trainer.max_epochs=2", "trainer.num_nodes=1", "test=false"
    )
    assert done.returncode == 0, done.stderr
    runs = [path for path in (tmp_path / "outputs" / "chair_unet").iterdir() if not path.is_symlink()]
    assert len(runs) == 1
    state = read_state(runs[0] / "checkpoints" / "last.ckpt")
    assert state["epoch"] == 1 and state[KEY]["values"]["seed"] == 3
    composed = runs[0] / "composed.yaml"
    text = composed.read_text()
    lines = text.splitlines(keepends=True)
    cut = [lines[:-1], lines[: lines.index("resume: null\n")], []]  # all of them are valid YAML
    damages = ["".join(some) for some in cut] + [text[: len(text) // 2], "["]
    for damaged in (*damages, text.replace("torch.optim.Adam", "os.system")):
        composed.write_text(damaged)
        done = command_in_process("train", "resume=latest")
        assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr


@pytest.mark.slow
def test_a_run_resumes_with_a_moved_dataset(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("litdata")
    assert command("prepare_shards", "scale=test", "views=8", "shards=before").returncode == 0
    job = [*JOB, "data=shards"]
    done = command("train", *job, "data.shards=before", "trainer.max_epochs=1")
    assert done.returncode == 0, done.stderr
    (tmp_path / "before").rename(tmp_path / "after")
    for place, code in (("before", 2), ("after", 0)):
        done = command("train", *job, f"data.shards={place}", "resume=latest", "trainer.max_epochs=2")
        assert done.returncode == code, done.stderr
    assert read_state(tmp_path / "outputs" / "chair_unet" / "latest" / LAST)["epoch"] == 1


def test_the_best_checkpoint_is_known_after_a_move(tmp_path: Path) -> None:
    names = {"monitor": "val/iou", "filename": "best", "mode": "max"}
    here, there = (MovableCheckpoint(dirpath=tmp_path / folder, **names) for folder in ("here", "there"))  # type: ignore[arg-type]
    best = str(tmp_path / "here" / "best.ckpt")
    here.best_model_path = here.kth_best_model_path = here.last_model_path = best
    here.best_model_score = here.kth_value = torch.tensor(0.5)
    here.best_k_models = {best: torch.tensor(0.5)}
    state = here.state_dict()
    assert str(tmp_path) not in str(state)
    there.load_state_dict(state)
    moved = str(tmp_path / "there" / "best.ckpt")
    assert there.best_model_path == there.kth_best_model_path == there.last_model_path == moved
    assert there.best_k_models == {moved: 0.5} and there.best_model_score == there.kth_value == 0.5
    fresh = MovableCheckpoint(dirpath=tmp_path / "there", **names)  # type: ignore[arg-type]
    fresh.load_state_dict(MovableCheckpoint(dirpath=tmp_path / "here", **names).state_dict())  # type: ignore[arg-type]
    assert fresh.best_model_path == "" and fresh.best_k_models == {} and fresh.best_model_score is None


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_trains_and_resumes(command: Command, tmp_path: Path, experiment: str) -> None:
    """One epoch with its checkpoint, a second one after resuming, and the final tables."""
    job = [f"+experiment={experiment}", "scale=test"]
    done = command("train", *job, "trainer.max_epochs=1", timeout=900)
    assert done.returncode == 0, done.stderr
    run = (tmp_path / "outputs" / experiment / "latest").resolve()
    assert read_state(run / LAST)["epoch"] == 0
    first = read_state(run / LAST)["state_dict"]
    done = command("train", "resume=latest", job[0], "trainer.max_epochs=2", timeout=900)
    assert done.returncode == 0, done.stderr
    last = read_state(run / LAST)
    assert last["epoch"] == 1
    assert any(not torch.equal(first[name], last["state_dict"][name]) for name in first)
    rows = (run / "tables" / "mapping.csv").read_text().splitlines()
    assert rows[0].startswith("approach,category,cell_width,trials,iou_pooled") and len(rows) > 4


@pytest.mark.slow
def test_the_same_seed_gives_the_same_tables(tmp_path: Path, command: Command) -> None:
    """Two trainings with separate empty caches; another seed gives other tables. In bfloat16, as at small scale."""
    learning = [
        "trainer.max_epochs=10",
        "model.optimizer.lr=0.01",
    ]  # predictions of untrained units are all equal
    job = [*JOB, *learning, "trainer.precision=bf16-mixed"]
    for folder, seed in (("one", 5), ("two", 5), ("other", 6)):
        done = command("train", *job, f"seed={seed}", f"paths.outputs={folder}", timeout=900)
        assert done.returncode == 0, done.stderr
    tables = {
        folder: {
            path.name: path.read_bytes()
            for path in (tmp_path / folder / "chair_unet" / "latest" / "tables").glob("*.csv")
        }
        for folder in ("one", "two", "other")
    }
    assert {"mapping.csv", "paired.csv", "mapping_details.csv", "ego.csv"} <= set(tables["one"])
    assert tables["one"] == tables["two"] != tables["other"]
    caches = [
        sorted(path.name for path in (tmp_path / folder / "cache").rglob("*.bin"))
        for folder in ("one", "two")
    ]
    assert caches[0] == caches[1] and caches[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("experiment", "moment"),
    [("chair_unet", 0.0), ("chair_unet", 0.35), ("chair_unet", 1.1), ("segmentation_hrnet", 0.35)],
)
def test_a_killed_run_ends_as_an_uninterrupted_one(
    tmp_path: Path, command: Command, experiment: str, moment: float
) -> None:
    """SIGKILL after the first checkpoint, move the folder, resume: the same weights, tables and curves."""
    job = [f"+experiment={experiment}", "scale=test", "trainer.check_val_every_n_epoch=2", "data.workers=1"]
    if experiment == "segmentation_hrnet":  # six epochs, beyond those in which its learning rate falls
        job += [
            "hrnet.max_epochs=8",
            "callbacks.early_stopping.patience=5",
            "callbacks.early_stopping.min_delta=1.0",
        ]
    else:
        job += ["trainer.max_epochs=6", "model.final_learning_rate=0.00001"]
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
    (broken / experiment / "latest" / ".last.ckpt.x.part").mkdir()  # as left by a kill while saving
    broken = broken.rename(tmp_path / "moved")
    done = command("train", "resume=latest", f"paths.outputs={broken}", timeout=900)
    assert done.returncode == 0, done.stderr
    assert not list((broken / experiment).rglob(".*.part"))
    for name in ("mapping.csv", "mapping_details.csv"):
        table = Path(experiment) / "latest" / "tables" / name
        assert (whole / table).read_bytes() == (broken / table).read_bytes()
    one, other = (read_state(outputs / last) for outputs in (whole, broken))
    assert one["epoch"] == other["epoch"] == 5
    assert all(torch.equal(one["state_dict"][name], other["state_dict"][name]) for name in one["state_dict"])
    assert one["optimizer_states"][0]["param_groups"] == other["optimizer_states"][0]["param_groups"]
    assert best_score(one) == best_score(other)
    curves = [points(outputs / experiment / "latest" / "tensorboard") for outputs in (whole, broken)]
    assert curves[0] == curves[1] and len(curves[0]["train/loss"]) == 12
    rates = {state["lr_schedulers"][0]["_last_lr"][0] for state in (one, other)}
    assert len(rates) == 1 and rates.pop() < 0.0001  # the end of the cosine schedule
    if experiment == "chair_unet":
        assert len(curves[0]["val/iou"]) == 3


def points(folder: Path) -> dict[str, list[int]]:
    """Return the steps of each curve and image in the event files of a run."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0}).Reload()
    curves = {tag: [event.step for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    return curves | {tag: [event.step for event in events.Images(tag)] for tag in events.Tags()["images"]}


def test_a_run_beyond_its_schedule_keeps_the_final_learning_rate() -> None:
    def schedule(kind: type, epochs: int, resumed: bool = False) -> list[float]:
        optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.1)
        scheduler, rates = kind(optimizer, T_max=5, eta_min=0.001), []
        for number in range(epochs):
            rates.append(optimizer.param_groups[0]["lr"])
            optimizer.step()
            scheduler.step()
            if resumed and number == 4:  # a checkpoint after the last epoch of the schedule
                states = optimizer.state_dict(), scheduler.state_dict()
                optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.1)
                scheduler = kind(optimizer, T_max=5, eta_min=0.001)
                optimizer.load_state_dict(states[0])
                scheduler.load_state_dict(states[1])
        return rates

    plain = schedule(torch.optim.lr_scheduler.CosineAnnealingLR, 12)
    assert max(plain[6:]) > 0.09  # PyTorch restarts the cosine
    for resumed in (False, True):
        ours = schedule(CosineAnnealing, 12, resumed)
        assert ours[:6] == plain[:6]
        assert ours[6:] == [ours[5]] * 6 and ours[5] == pytest.approx(0.001)


def test_latest_is_restored(tmp_path: Path) -> None:
    old, new = (create_folder(tmp_path, name) for name in ("old", "new"))
    assert point_latest(old) is None
    previous = point_latest(new)
    assert previous == old
    restore_latest(new, previous)
    assert (tmp_path / "latest").readlink() == Path("old")
    restore_latest(new, previous)  # latest points to another run now
    assert (tmp_path / "latest").readlink() == Path("old")
    restore_latest(old, None)
    assert not (tmp_path / "latest").is_symlink()


def best_score(state: dict[str, Any]) -> float:
    scores = [
        entry.get("best_model_score") for entry in state["callbacks"].values() if isinstance(entry, dict)
    ]
    return max(float(score) for score in scores if score is not None)
