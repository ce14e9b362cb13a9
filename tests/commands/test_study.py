"""The study's chain: which runs count as done, which are resumed, and what is refused before anything is trained."""

from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from imagination.config.user_messages import explain
from imagination.runs.finished_trainings import evaluated, planned, trained_key
from imagination.runs.folder import COMPOSED
from imagination.study import _run, check, trained
from imagination.utils.errors import UserError
from tests.conftest import Command

OVERRIDES = ["scale=test"]
DONE = "tables/mapping.csv", "checkpoints/last.ckpt"


def run(outputs: Path, date: str, overrides: list[str], *files: str) -> Path:
    """A run's folder, as imagination.train leaves it."""
    config = planned("chair_unet", overrides)
    folder = outputs / "chair_unet" / date
    for name in ("run.log", *files):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    config.paths.run, config.sweep_dir = str(folder), None
    OmegaConf.save(config, folder / COMPOSED)
    return folder


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Command lines instead of commands; training makes a finished run."""
    lines: list[str] = []

    def pretend(name: str, *overrides: list[str]) -> None:
        texts = [text for part in overrides for text in part]
        lines.append(" ".join([name, *texts]))
        if not texts[0].startswith("ckpt_path"):
            run(tmp_path, "new", texts[1:], *DONE, "checkpoints/best.ckpt")

    monkeypatch.setattr("imagination.study._run", pretend)
    return lines


def test_nothing_there_is_trained(tmp_path: Path, called: list[str]) -> None:
    overrides = ["scale=test", f"paths.outputs={tmp_path}"]
    assert trained("chair_unet", overrides, tmp_path) == tmp_path / "chair_unet/new/checkpoints/best.ckpt"
    assert called == [f"train +experiment=chair_unet scale=test paths.outputs={tmp_path}"]
    trained("chair_unet", overrides, tmp_path)
    assert len(called) == 1  # and not again


def test_the_newest_finished_run_of_the_same_config_counts(tmp_path: Path, called: list[str]) -> None:
    run(tmp_path, "1", OVERRIDES, *DONE)
    wanted = run(tmp_path, "2", ["seed=0", *OVERRIDES], *DONE)  # told in other words
    run(tmp_path, "3", [*OVERRIDES, "seed=1"], *DONE)
    run(tmp_path, "4", OVERRIDES, "checkpoints/last.ckpt")
    (tmp_path / "chair_unet" / "latest").symlink_to("3")
    assert trained("chair_unet", OVERRIDES, tmp_path) == wanted / "checkpoints/last.ckpt"
    assert not called


@pytest.mark.parametrize(
    "other",
    [
        "trainer.max_epochs=1",
        "trainer.fast_dev_run=true",
        "callbacks.replay_buffer.update_batches=1",
        "evaluation.viewpoint_sets=2",  # an evaluation would take it over from the run
    ],
)
def test_a_run_that_was_trained_or_measured_in_another_way_does_not_count(
    tmp_path: Path, called: list[str], other: str
) -> None:
    run(tmp_path, "1", [*OVERRIDES, other], *DONE)
    trained("chair_unet", OVERRIDES, tmp_path)
    assert called == ["train +experiment=chair_unet scale=test"]


def test_a_run_of_other_code_does_not_count(
    tmp_path: Path, called: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path, "1", OVERRIDES, *DONE)
    trained("chair_unet", OVERRIDES, tmp_path)
    assert called == []
    monkeypatch.setattr("imagination.runs.finished_trainings.code_version", lambda packages: "another")
    trained("chair_unet", OVERRIDES, tmp_path)
    assert called == ["train +experiment=chair_unet scale=test"]


def test_a_run_without_a_checkpoint_does_not_count(tmp_path: Path, called: list[str]) -> None:
    run(tmp_path, "1", OVERRIDES, "tables/mapping.csv")
    trained("chair_unet", OVERRIDES, tmp_path)
    assert called == ["train +experiment=chair_unet scale=test"]


@pytest.mark.parametrize("config", ["[" * 3000, "seed: " + "9" * 5000, "- 1", "a: !!bool x"])
def test_a_damaged_run_does_not_count(
    tmp_path: Path, called: list[str], caplog: pytest.LogCaptureFixture, config: str
) -> None:
    folder = run(tmp_path, "1", OVERRIDES, *DONE)
    (folder / COMPOSED).write_text(config)
    trained("chair_unet", OVERRIDES, tmp_path)
    assert len(called) == 1 and "composed.yaml is damaged" in caplog.text


def test_an_unfinished_run_is_resumed(tmp_path: Path, called: list[str]) -> None:
    folder = run(tmp_path, "1", OVERRIDES, "checkpoints/last.ckpt")
    run(tmp_path, "2", OVERRIDES)  # ended before its first round
    trained("chair_unet", OVERRIDES, tmp_path)
    assert called == [f"train ckpt_path={folder}/checkpoints/last.ckpt"]


def test_what_only_evaluation_reads_retrains_nothing() -> None:
    for override in (
        "scale.cell_widths=[4.0]",
        "mapping/registration=mean",
        "evaluation.only=[seg_gt]",
        "ade20k=a",
    ):
        assert evaluated(override), override
    for override in ("scale=test", "kernels.imaginable=1.2", "model/loss=bce_dice", "scale.epochs=3"):
        assert not evaluated(override), override


@pytest.mark.parametrize(
    ("experiments", "evaluation", "told"),
    [
        (["chair_unet", "chair_best"], [], "got chair_unet and chair_best, which both give chair"),
        (["chair_unet", "segmentation_hrnet"], ["ade20k=a"], "got a beside checkpoint segmentation_hrnet"),
        ([], [], "experiments: got none"),
        (["chair_unet"], ["evaluation.viewpoint_sets=0"], "viewpoint_sets: got 0"),
        (["chair_unet"], ["evaluation.only=[seg_gd]"], "evaluation.only: got 'seg_gd'"),
    ],
)
def test_mistakes_are_told_before_anything_is_trained(
    experiments: list[str], evaluation: list[str], told: str
) -> None:
    with pytest.raises((UserError, HydraException)) as caught:
        check(experiments, OVERRIDES, ["+study=paper", *evaluation])
    assert told in (explain(caught.value) or "")


def test_an_unknown_comparison_trains_nothing(command: Command, tmp_path: Path) -> None:
    done = command("study", "scale=test", "compare=nothing", "experiments=[chair_unet]")
    assert done.returncode == 2 and "study/nothing" in done.stderr, done.stderr
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize("word", ["-m", "+sweep=weights", "+hparams_search=optuna"])
def test_sweeps_are_refused(command: Command, word: str) -> None:
    """Each member's trainings would be a sweep again."""
    done = command("study", "scale=test", word)
    assert done.returncode == 2 and "imagination.study knows no sweeps" in done.stderr


def test_what_only_the_other_network_reads_retrains_nothing() -> None:
    scale = planned("segmentation_hrnet", OVERRIDES).scale
    of_hrnet = [f"scale.{key}={2 * scale[key]}" for key in scale if key.startswith("hrnet_")]
    changes = ([], ["scale.hrnet=hrnet_w48"], *([change] for change in of_hrnet))

    def keys(experiment: str) -> set[str]:
        return {trained_key(planned(experiment, [*OVERRIDES, *change])) for change in changes}

    assert len(keys("chair_unet")) == 1 and len(keys("segmentation_hrnet")) == len(changes) > 5


def test_a_failure_ends_the_study_with_its_code() -> None:
    with pytest.raises(SystemExit, match="2"):
        _run("train", ["scale=huge"])
