"""The study: reuse of finished runs, resuming of unfinished ones, and checks before the trainings."""

from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from imagination.config.user_messages import explain
from imagination.runs.command import run_command
from imagination.runs.composed_config import END
from imagination.runs.final_record import FINAL, read_final_record, write_final_record
from imagination.runs.finished_trainings import (
    is_evaluation_only,
    train_or_reuse,
    training_config,
    training_key,
)
from imagination.runs.folder import COMPOSED
from imagination.study import check_evaluation, check_seeds, combine, evaluate_seed
from imagination.utils.errors import UserError
from imagination.utils.tabular import read_csv
from tests.conftest import Command
from tests.helpers.run_folders import make_folder

OVERRIDES = ["scale=test"]
DONE = FINAL, "checkpoints/last.ckpt"


def run(outputs: Path, date: str, overrides: list[str], *files: str) -> Path:
    """Write a run folder as imagination.train does."""
    config = training_config("chair_unet", overrides)
    folder = outputs / "chair_unet" / date
    for name in ("run.log", *files):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    if FINAL in files:
        write_final_record(folder, max_epochs=config.trainer.max_epochs)
    config.paths.run = str(folder)
    (folder / COMPOSED).write_text(OmegaConf.to_yaml(config) + END)
    return folder


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Record command lines instead of running commands; a training finishes a new run or the resumed one."""
    lines: list[str] = []

    def record(name: str, arguments: list[str]) -> None:
        lines.append(" ".join([name, *arguments]))
        if arguments[0].startswith("resume="):
            epochs = training_config("chair_unet", OVERRIDES).trainer.max_epochs
            write_final_record(Path(arguments[0].removeprefix("resume=")), max_epochs=epochs)
        else:
            run(tmp_path, "new", arguments[1:], *DONE, "checkpoints/best.ckpt")

    monkeypatch.setattr("imagination.runs.finished_trainings.run_command", record)
    return lines


def test_a_missing_run_is_trained(tmp_path: Path, called: list[str]) -> None:
    overrides = ["scale=test", f"paths.outputs={tmp_path}"]
    assert (
        train_or_reuse("chair_unet", overrides, tmp_path) == tmp_path / "chair_unet/new/checkpoints/best.ckpt"
    )
    assert called == [f"train experiment=chair_unet scale=test paths.outputs={tmp_path}"]
    train_or_reuse("chair_unet", overrides, tmp_path)
    assert len(called) == 1  # not trained again


def test_the_newest_finished_run_of_the_same_config_counts(tmp_path: Path, called: list[str]) -> None:
    run(tmp_path, "1", OVERRIDES, *DONE)
    wanted = run(tmp_path, "2", ["seed=0", *OVERRIDES], *DONE)  # equal overrides in another order
    run(tmp_path, "3", [*OVERRIDES, "seed=1"], *DONE)
    run(tmp_path, "4", OVERRIDES, "checkpoints/last.ckpt")
    (tmp_path / "chair_unet" / "latest").symlink_to("3")
    assert train_or_reuse("chair_unet", OVERRIDES, tmp_path) == wanted / "checkpoints/last.ckpt"
    assert not called


@pytest.mark.parametrize(
    "other",
    [
        "trainer.max_epochs=1",
        pytest.param("trainer.fast_dev_run=true", marks=pytest.mark.slow),
        pytest.param("callbacks.replay_buffer.update_batches=1", marks=pytest.mark.slow),
        "evaluation.viewpoint_sets=2",  # the evaluation would inherit it from the run
    ],
)
def test_a_run_with_other_settings_does_not_count(tmp_path: Path, called: list[str], other: str) -> None:
    run(tmp_path, "1", [*OVERRIDES, other], *DONE)
    train_or_reuse("chair_unet", OVERRIDES, tmp_path)
    assert called == ["train experiment=chair_unet scale=test"]


def test_a_run_of_other_code_does_not_count(
    tmp_path: Path, called: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path, "1", OVERRIDES, *DONE)
    train_or_reuse("chair_unet", OVERRIDES, tmp_path)
    assert called == []
    monkeypatch.setattr("imagination.runs.finished_trainings.program", lambda config: "another")
    train_or_reuse("chair_unet", OVERRIDES, tmp_path)
    assert called == ["train experiment=chair_unet scale=test"]


def test_a_run_without_a_checkpoint_does_not_count(tmp_path: Path, called: list[str]) -> None:
    run(tmp_path, "1", OVERRIDES, FINAL)
    train_or_reuse("chair_unet", OVERRIDES, tmp_path)
    assert called == ["train experiment=chair_unet scale=test"]


@pytest.mark.parametrize("config", ["[" * 3000, "seed: " + "9" * 5000, "- 1", "a: !!bool x"])
def test_a_damaged_run_does_not_count(
    tmp_path: Path, called: list[str], caplog: pytest.LogCaptureFixture, config: str
) -> None:
    folder = run(tmp_path, "1", OVERRIDES, *DONE)
    (folder / COMPOSED).write_text(config)
    train_or_reuse("chair_unet", OVERRIDES, tmp_path)
    assert len(called) == 1 and "composed.yaml" in caplog.text


def test_an_unfinished_run_is_resumed(tmp_path: Path, called: list[str]) -> None:
    folder = run(tmp_path, "1", OVERRIDES, "checkpoints/last.ckpt")
    run(tmp_path, "2", OVERRIDES)  # ended before its first checkpoint
    assert train_or_reuse("chair_unet", OVERRIDES, tmp_path).is_relative_to(folder)
    assert called == [f"train resume={folder}"]


def test_tables_alone_do_not_finish_a_run(tmp_path: Path, called: list[str]) -> None:
    """As of a run that was killed while it wrote its results."""
    folder = run(tmp_path, "1", OVERRIDES, "checkpoints/last.ckpt", "tables/mapping.csv")
    train_or_reuse("chair_unet", OVERRIDES, tmp_path)
    assert called == [f"train resume={folder}"]


def test_a_run_that_was_shortened_does_not_count(tmp_path: Path, called: list[str]) -> None:
    """It was resumed with a smaller trainer.max_epochs, which is not in its composed config."""
    folder = run(tmp_path, "1", OVERRIDES, *DONE)
    write_final_record(folder, max_epochs=1)
    train_or_reuse("chair_unet", OVERRIDES, tmp_path)
    assert called == [f"train resume={folder}"]


def test_a_training_that_ends_unfinished_is_not_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A subprocess that ends with exit code 0 before its run is finished."""
    monkeypatch.setattr("imagination.runs.finished_trainings.run_command", lambda name, arguments: None)
    run(tmp_path, "1", OVERRIDES, "checkpoints/last.ckpt", "checkpoints/best.ckpt", "tables/mapping.csv")
    with pytest.raises(UserError, match="chair_unet: .*final record"):
        train_or_reuse("chair_unet", OVERRIDES, tmp_path)


def test_evaluation_settings_retrain_nothing() -> None:
    for override in (
        "evaluation.cell_widths=[4.0]",
        "mapping/registration=mean",
        "evaluation.only=[seg_gt]",
        "ade20k=a",
    ):
        assert is_evaluation_only(override), override
    for override in ("scale=test", "kernels.imaginable=1.2", "model/loss=bce_dice", "trainer.max_epochs=3"):
        assert not is_evaluation_only(override), override


@pytest.mark.parametrize(
    ("experiments", "evaluation", "message"),
    [
        (["chair_unet", "chair_best"], [], "got chair_unet and chair_best"),
        (["chair_unet", "segmentation_hrnet"], ["ade20k=a"], "ade20k: got a"),
        ([], [], "experiments: got none"),
        (["chair_unet"], ["evaluation.viewpoint_sets=0"], "viewpoint_sets: got 0"),
        (["chair_unet"], ["evaluation.only=[seg_gd]"], "evaluation.only: got 'seg_gd'"),
    ],
)
def test_invalid_settings_are_refused_before_the_trainings(
    experiments: list[str], evaluation: list[str], message: str
) -> None:
    with pytest.raises((UserError, HydraException)) as caught:
        check_evaluation(experiments, OVERRIDES, ["+study=paper", *evaluation])
    assert message in (explain(caught.value) or "")


def test_an_unknown_comparison_trains_nothing(command_in_process: Command, tmp_path: Path) -> None:
    done = command_in_process("study", "scale=test", "compare=nothing", "experiments=[chair_unet]")
    assert done.returncode == 2 and "study: got 'nothing'" in done.stderr, done.stderr
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize("word", ["-m", "+sweep=weights", "+hparams_search=optuna"])
def test_sweeps_are_refused(command_in_process: Command, word: str) -> None:
    """The trainings of each job would be a sweep again."""
    done = command_in_process("study", "scale=test", word)
    assert done.returncode == 2 and "-m: imagination.study " in done.stderr


@pytest.mark.slow
def test_settings_of_the_segmentation_network_retrain_no_unit() -> None:
    values = training_config("segmentation_hrnet", OVERRIDES).hrnet
    hrnet = [f"hrnet.{key}={2 * value}" for key, value in values.items() if key != "network"]
    hrnet.append("hrnet.network=hrnet_w48")

    def key(experiment: str, *changes: str) -> str:
        return training_key(training_config(experiment, [*OVERRIDES, *changes]))

    assert key("chair_unet") == key("chair_unet", *hrnet)
    keys = {key("segmentation_hrnet", change) for change in hrnet} | {key("segmentation_hrnet")}
    assert len(keys) == len(hrnet) + 1 > 5


@pytest.mark.parametrize(
    ("seeds", "overrides", "message"),
    [
        ([], [], "seeds: got []"),
        ([1, 1], [], "seeds: got [1, 1]"),
        ([0, "one"], [], "seeds: got [0, 'one']"),
        ([-1], [], "seeds: got [-1]"),
        (3, [], "seeds: got 3"),
        ([0, 1], ["seed=3"], "seed: got seed=3 and seeds=[0, 1]"),
    ],
)
def test_invalid_seeds_are_refused(seeds: object, overrides: list[str], message: str) -> None:
    with pytest.raises(UserError) as caught:
        check_seeds(OmegaConf.create({"seeds": seeds}).seeds, overrides)
    assert message in str(caught.value)


def test_each_seed_is_trained_and_evaluated_and_all_are_combined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[str, ...]] = []

    def train(experiment: str, overrides: list[str], outputs: Path) -> Path:
        calls.append((experiment, *overrides))
        return outputs / f"{experiment}.ckpt"

    def evaluate(name: str, arguments: list[str]) -> None:
        calls.append((name, *arguments))
        folder = Path(arguments[-1].removeprefix("hydra.run.dir="))
        assert not (folder / FINAL).exists()  # a finished evaluation is repeated, from the cache
        make_folder(folder, seed=int(folder.name.removeprefix("seed_")))

    monkeypatch.setattr("imagination.study.train_or_reuse", train)
    monkeypatch.setattr("imagination.study.run_command", evaluate)
    config = OmegaConf.create({"experiments": ["chair_unet"], "paths": {"outputs": str(tmp_path)}})
    study = tmp_path / "study"
    (study / "seed_3").mkdir(parents=True)
    write_final_record(study / "seed_3")
    for seed in (0, 3):
        evaluate_seed(config, seed, ["scale=test"], ["study=paper"], study)
    assert calls[:2] == [
        ("chair_unet", "scale=test", "seed=0"),
        ("evaluate", f'ckpt=["{tmp_path}/chair_unet.ckpt"]', "study=paper", f"hydra.run.dir={study}/seed_0"),
    ]
    assert calls[2][-1] == "seed=3" and calls[3][-1].endswith("seed_3")
    combine(study, [0, 3])
    rows = read_csv(study / "tables" / "mapping.csv")
    assert {row["seeds"] for row in rows} == {"2"} and all(row["iou_seed_std"] for row in rows)
    assert read_final_record(study) is not None


def test_a_failure_ends_the_study_with_its_code() -> None:
    with pytest.raises(SystemExit, match="2"):
        run_command("train", ["scale=huge"])
