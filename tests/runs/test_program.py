"""Code of a training: edited code of a plugin is another training, unless only the evaluation uses it."""

from copy import deepcopy
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from imagination.runs.composed_config import END
from imagination.runs.final_record import write_final_record
from imagination.runs.finished_trainings import newest_run, training_config
from imagination.runs.folder import COMPOSED, LAST
from imagination.runs.program import program
from tests.helpers.plugin_modules import edit, new_process, write

TRAINED = {
    "loss": "model.loss._target_",
    "unit": "model.unit._target_",
    "encoder": "model.encoder._target_",
    "source": "data.scenes._target_",
    "sampler": "data.sampler._target_",
}
EVALUATED = {"rule": "mapping.registration._target_"}
LOSS = ["scale=test", "model.loss._target_=edited_training.loss.Class"]


@pytest.fixture(scope="module")
def base() -> DictConfig:
    return training_config("chair_unet", ["scale=test"])


@pytest.fixture
def plugin(tmp_path: Path) -> Path:
    folder = tmp_path / "edited_training"
    modules = dict.fromkeys([*TRAINED, *EVALUATED], "from edited_training.shared import Class\n")
    write(folder, **modules, shared="class Class: ...\n")
    return folder


@pytest.mark.parametrize("name", [*TRAINED, *EVALUATED])
def test_an_edited_class_is_another_program_if_the_training_uses_it(
    base: DictConfig, plugin: Path, name: str
) -> None:
    def hashed(config: DictConfig) -> str:
        with new_process(plugin.parent):
            return program(config)

    used, unused = deepcopy(base), deepcopy(base)
    for other, key in (TRAINED | EVALUATED).items():
        OmegaConf.update(used if other == name else unused, key, f"edited_training.{other}.Class")
    before, without = hashed(used), hashed(unused)
    assert hashed(used) == before
    with open(plugin / f"{name}.py", "a") as module:
        module.write("# a comment\n")
    assert (hashed(used) != before) == (name in TRAINED)
    assert hashed(unused) == without
    edit(plugin / "shared.py", "...", "pass")
    assert hashed(unused) != without


def test_a_training_with_an_edited_loss_is_not_reused(plugin: Path, tmp_path: Path) -> None:
    outputs = tmp_path / "outputs"
    folder = outputs / "chair_unet" / "1"

    def found() -> Path | None:
        with new_process(tmp_path):
            return newest_run(outputs, training_config("chair_unet", LOSS), finished=True)

    with new_process(tmp_path):
        config = training_config("chair_unet", LOSS)
    (folder / LAST).parent.mkdir(parents=True)
    (folder / LAST).touch()
    write_final_record(folder, max_epochs=config.trainer.max_epochs)
    config.paths.run = str(folder)
    (folder / COMPOSED).write_text(OmegaConf.to_yaml(config) + END)
    assert found() == folder
    edit(plugin / "shared.py", "...", "pass")
    assert found() is None
