"""The study's chain: which runs count as done, which are resumed."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from imagination import runs, study

CHOICES = ["+experiment=chair_unet", "scale=test"]


def run(outputs: Path, date: str, choices: list[str], *files: str) -> Path:
    folder = outputs / "chair_unet" / date
    for name in ("run.log", *files):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    OmegaConf.save({"choices": choices}, folder / runs.COMPOSED)
    return folder


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Command lines instead of commands; training makes a finished run."""
    lines: list[str] = []

    def pretend(name: str, *overrides: list[str]) -> None:
        texts = [text for part in overrides for text in part]
        lines.append(" ".join([name, *texts]))
        if not texts[0].startswith("ckpt_path"):
            run(tmp_path, "new", study.choices(texts), "tables/mapping.csv", "checkpoints/best.ckpt")

    monkeypatch.setattr(study, "_run", pretend)
    return lines


def test_nothing_there_is_trained(tmp_path: Path, called: list[str]) -> None:
    overrides = ["scale=test", f"paths.outputs={tmp_path}"]
    assert (
        study.trained("chair_unet", overrides, tmp_path) == tmp_path / "chair_unet/new/checkpoints/best.ckpt"
    )
    assert called == [f"train +experiment=chair_unet scale=test paths.outputs={tmp_path}"]
    study.trained("chair_unet", overrides, tmp_path)
    assert len(called) == 1  # and not again


def test_the_newest_finished_run_with_the_same_choices_counts(tmp_path: Path, called: list[str]) -> None:
    done = "tables/mapping.csv", "checkpoints/last.ckpt"
    run(tmp_path, "1", CHOICES, *done)
    wanted = run(tmp_path, "2", CHOICES[::-1], *done)
    run(tmp_path, "3", [*CHOICES, "seed=1"], *done)
    run(tmp_path, "4", CHOICES, "checkpoints/last.ckpt")
    (tmp_path / "chair_unet" / "latest").symlink_to("3")
    assert study.trained("chair_unet", ["scale=test"], tmp_path) == wanted / "checkpoints/last.ckpt"
    assert not called


def test_an_unfinished_run_is_resumed(tmp_path: Path, called: list[str]) -> None:
    folder = run(tmp_path, "1", CHOICES, "checkpoints/last.ckpt")
    run(tmp_path, "2", CHOICES)  # ended before its first round
    study.trained("chair_unet", ["scale=test"], tmp_path)
    assert called == [f"train ckpt_path={folder}/checkpoints/last.ckpt"]


def test_a_failure_ends_the_study_with_its_code() -> None:
    with pytest.raises(SystemExit, match="2"):
        study._run("train", ["scale=huge"])
