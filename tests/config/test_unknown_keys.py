"""Misspelt keys, groups and options are refused with the closest names; real additions pass."""

from pathlib import Path

import pytest

from imagination.config.compose import compose
from imagination.config.key_roles import OPTIONAL_GROUPS
from imagination.config.plugin_registry import core_conf
from imagination.utils.errors import UserError
from tests.conftest import Command


@pytest.mark.parametrize(
    ("override", "closest"),
    [
        ("sede=3", "seed"),
        ("+sede=3", "seed"),
        ("++sede=3", "seed"),
        ("experimnet=bed_unet", "experiment"),
        ("+experimnet=bed_unet", "experiment"),
        ("model/encodr=timm", "model/encoder"),
        ("+model/encodr=timm", "model/encoder"),
        ("trainer.max_epoch=3", "trainer.max_epochs"),
        ("+trainer.profilr=simple", "trainer.profiler"),
        ("+data.scenes.sed=3", "data.scenes.seed"),
        ("+kernels.imaginabel=1.0", "kernels.imaginable"),
        ("batch_size=3", "data.batch_size"),
        ("scale=tset", "test"),
        ("+experiment=chair_unte", "chair_unet"),
        ("callbacks=[defalt]", "default"),
    ],
)
def test_a_misspelt_name_is_refused_with_the_closest(override: str, closest: str) -> None:
    with pytest.raises(UserError) as error:
        compose("train", [override])
    name, _, hint = str(error.value).partition("did you mean ")
    assert closest in hint.split("?")[0].split(", ")
    assert name.startswith(override.partition("=")[0].lstrip("+"))


@pytest.mark.parametrize(
    "override",
    [
        "+trainer.profiler=simple",
        "+ground_truth.camera.pitch=5.0",
        "+categories.sofa={colour: [1, 2, 3], aliases: {procedural: [sofa]}}",
        "+categories.chair.aliases.mine=[seat]",
        "+callbacks.mine={_target_: lightning.pytorch.callbacks.Timer}",
        "+hydra.job.env_set={A: b}",
        "+experiment=chair_unet",
        "experiment=chair_unet",
        "++seed=3",
    ],
)
def test_arguments_of_targets_and_rows_of_tables_are_added(override: str) -> None:
    compose("train", [override])


def test_the_optional_groups_are_those_without_a_default() -> None:
    optional = {
        line.strip(" -").partition(":")[0]
        for file in core_conf().glob("*.yaml")
        for line in file.read_text().splitlines()
        if line.startswith("  - ") and line.partition("#")[0].rstrip().endswith(": null")
    }
    assert optional == set(OPTIONAL_GROUPS)


def test_a_command_refuses_a_misspelt_name_before_it_starts(
    command_in_process: Command, tmp_path: Path
) -> None:
    done = command_in_process("train", "+experiment=chair_unet", "scale=test", "+sede=3")
    assert done.returncode == 2
    assert "sede" in done.stderr and "seed" in done.stderr
    assert not (tmp_path / "outputs").exists()
