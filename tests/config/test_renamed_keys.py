"""Keys and options of earlier versions are refused with the new name."""

import shlex

import pytest
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.config.renamed_keys import (
    RENAMED_KEYS,
    RENAMED_OPTIONS,
    as_overrides,
    check_renamed,
    renamed,
)
from imagination.utils.errors import UserError
from tests.conftest import ROOT, Command


@pytest.mark.parametrize(
    ("command", "override", "expected"),
    [
        ("train", "scale=desk", "scale=small"),
        ("train", "scale.homes.train=3", "data.splits.train=3"),
        ("train", "scale.epochs=3", "trainer.max_epochs=3"),
        ("train", "scale.scenes={train: 3, val: 1, test: 1}", "data.splits={train: 3, val: 1, test: 1}"),
        ("train", "+callbacks.until_flat.margin=0.1", "callbacks.early_stopping.min_delta=0.1"),
        ("train", "callbacks=[replay_buffer,record]", "callbacks=training_stats"),
        ("train", "model.unit.mirrored_answers=true", "model.unit.tta_hflip=true"),
        ("evaluate", "mapping/registration=overwrite", "mapping/registration=latest"),
        (
            "evaluate",
            "evaluation.approaches.mine.finish=grow",
            "evaluation.approaches.mine.postprocess=dilate",
        ),
        ("train", "categories.chair.members.mine=[seat]", "categories.chair.aliases.mine=[seat]"),
        ("render", "+shards=folder", "python -m imagination.prepare_shards shards=folder"),
        ("map", "limits.tilt=60", "semantic_mapper"),
        ("export", "look_once=true", "tta_hflip"),
        ("evaluate", "evaluation.approaches.mine.evidence.needs=plain_maps", "needs=raw_maps"),
        ("train", "~callbacks.until_flat", "callbacks.early_stopping"),
        ("train", "~evaluation.approaches.imagination_dilated", "imagination_dilated"),
        ("map", "viewer.most=5", "viewer.max_frames=5"),
        ("train", "sweep_dir=outputs/old", "hydra.sweep.dir=outputs/old"),
    ],
)
def test_old_names_are_refused_with_the_new_one(command: str, override: str, expected: str) -> None:
    with pytest.raises(UserError) as error:
        check_renamed(command, [override])
    assert expected in str(error.value)


@pytest.mark.parametrize(
    "override",
    ["trainer.max_epochs=3", "seed=1", "name=overwrite", "-m", "--help", "callbacks=[default]", "x.homes=2"],
)
def test_todays_names_pass(override: str) -> None:
    check_renamed("train", [override])


def test_new_names_exist_and_old_ones_do_not() -> None:
    """Renamed keys and options are those of the configuration as it is."""
    config = compose("train", ["+experiment=segmentation_hrnet", "data/sampler=balanced", "paths.run=."])
    units = compose("train", ["+experiment=chair_unet", "paths.run=."])
    for old, new in RENAMED_KEYS.items():
        if old.startswith("viewer.") or new.startswith("hydra."):
            continue  # of the map command, or of Hydra
        assert any(OmegaConf.select(each, new) is not None for each in (config, units)), new
        assert all(OmegaConf.select(each, old) is None for each in (config, units)), old
    for (group, old), new in RENAMED_OPTIONS.items():
        assert (ROOT / "conf" / group / f"{new}.yaml").is_file(), (group, new)
        assert not (ROOT / "conf" / group / f"{old}.yaml").exists(), (group, old)


def test_renaming_is_final() -> None:
    for name in RENAMED_KEYS.values():
        assert renamed(name) == name


def test_commands_refuse_old_names(command_in_process: Command) -> None:
    done = command_in_process("train", "+experiment=chair_unet", "scale=test", "scale.rounds=1")
    assert done.returncode == 2
    assert "scale.rounds" in done.stderr and "trainer.max_epochs=1" in done.stderr


@pytest.mark.parametrize(
    ("command", "words", "expected"),
    [
        ("report", ["outputs/made/latest"], ["folder=outputs/made/latest"]),
        ("report", ["a", "--docs", "docs/b"], ["folder=a", "docs=docs/b"]),
        ("report", ["--docs=docs/b", "a"], ["docs=docs/b", "folder=a"]),
        ("report", ["a", "--docs"], ["folder=a", "docs=PAGE"]),
        ("report", ["my run"], ["folder='my run'"]),
        ("assets", ["sweethome3d", "list=true"], ["name=sweethome3d", "list=true"]),
        ("map", ["recording=tum", "--preview"], ["recording=tum", "viewer=preview"]),
    ],
)
def test_arguments_of_earlier_versions_are_refused_with_the_overrides(
    command: str, words: list[str], expected: list[str]
) -> None:
    with pytest.raises(UserError) as error:
        check_renamed(command, words)
    assert str(error.value).endswith(shlex.join(["python", "-m", f"imagination.{command}", *expected]))
    assert as_overrides(command, expected) == expected


@pytest.mark.parametrize(
    "words",
    [
        ["folder=a", "--cfg", "job"],
        ["--help"],
        ["-sc", "query=bash"],
        ["~docs"],
        ["--cfg", "hydra", "-p", "hydra.job"],
    ],
)
def test_options_of_hydra_keep_their_values(words: list[str]) -> None:
    assert as_overrides("report", words) == words
    check_renamed("report", words)
