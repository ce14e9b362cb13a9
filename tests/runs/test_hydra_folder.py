"""Hydra's folders: created late and exclusively, described by .hydra/, one folder for each sweep."""

from collections.abc import Iterator
from pathlib import Path

import hydra
import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig, open_dict

from imagination.config.overrides import assignment
from imagination.config.plugin_registry import core_conf
from imagination.config.search_path import register_plugins
from imagination.runs import sweep_jobs
from imagination.runs.folder import COMPOSED
from imagination.runs.hydra_folder import check_hydra_overrides, new_run_folder
from imagination.runs.sweep import Sweep
from imagination.utils.errors import UserError
from tests.conftest import Command

JOB = ["experiment=chair_unet", "scale=test"]


@pytest.fixture
def in_hydra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Initialize Hydra in an empty folder, as a command does."""
    monkeypatch.chdir(tmp_path)
    register_plugins()
    with hydra.initialize_config_dir(str(core_conf()), version_base="1.3"):
        yield
    HydraConfig.instance().cfg = None


def start(*overrides: str, name: str = "train") -> DictConfig:
    """Compose the config of a command, with its `hydra` node."""
    loader = GlobalHydra.instance().config_loader()
    config = loader.load_configuration(name, list(overrides), RunMode.RUN)
    config.hydra.mode = RunMode.RUN
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        task: DictConfig = config.copy()
        del task["hydra"]
    return task


def test_default_folders_are_never_shared(in_hydra: None) -> None:
    folders = []
    for _ in range(3):
        config = start(*JOB, "hydra.run.dir=${paths.outputs}/${name}/now")
        folders.append(new_run_folder(config))
        assert HydraConfig.get().run.dir == str(folders[-1])
        assert HydraConfig.get().runtime.output_dir == str(folders[-1].resolve())
    assert folders == [Path("outputs/chair_unet") / name for name in ("now", "now_1", "now_2")]


def test_a_folder_that_holds_a_run_is_refused(in_hydra: None, tmp_path: Path) -> None:
    config = start(*JOB, "hydra.run.dir=mine")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    assert new_run_folder(config) == Path("mine")
    (tmp_path / "mine" / COMPOSED).touch()
    for continues in (False, True):
        with pytest.raises(UserError, match=r"hydra\.run\.dir: got mine.*resume=mine"):
            new_run_folder(start(*JOB, "hydra.run.dir=mine"), continues=continues)


def test_a_folder_is_described_as_by_hydra(in_hydra: None) -> None:
    folder = new_run_folder(start(*JOB, "seed=3", "hydra.run.dir=mine")) / ".hydra"
    config, hydra_config, overrides = (
        yaml.safe_load((folder / f"{name}.yaml").read_text()) for name in ("config", "hydra", "overrides")
    )
    assert config["seed"] == 3 and overrides == [*JOB, "seed=3"]
    assert hydra_config["hydra"]["run"]["dir"] == "mine"
    assert hydra_config["hydra"]["overrides"]["task"] == overrides


@pytest.mark.parametrize("word", ["hydra.output_subdir=x", "hydra.sweep.subdir=x", "hydra.job.chdir=true"])
def test_keys_without_an_effect_are_refused(word: str) -> None:
    with pytest.raises(UserError, match=f"{word.partition('=')[0]}: got"):
        check_hydra_overrides("train", [word])
    check_hydra_overrides("train", ["hydra.output_subdir=null", "hydra.run.dir=x", "hydra.job.chdir=false"])
    with pytest.raises(UserError, match=r"hydra\.run\.dir: got 'x', but imagination.render"):
        check_hydra_overrides("render", ["hydra.run.dir=x"])


def sweep(*overrides: str, name: str = "train") -> Path:
    """Start a sweep as Hydra does, and return its folder."""
    loader = GlobalHydra.instance().config_loader()
    config = loader.load_configuration(name, list(overrides), RunMode.MULTIRUN)
    Sweep().on_multirun_start(config, config_name=name)
    folder = Path(config.hydra.sweep.dir)
    job = loader.load_sweep_config(config, ["experiment=bed_unet", "name=other"])
    assert Path(job.hydra.sweep.dir) == folder  # whatever a job changes
    return folder


@pytest.mark.parametrize(
    ("overrides", "parent"),
    [
        (["experiment=chair_unet", "seed=1,2"], "outputs/chair_unet"),
        (["experiment=chair_unet,bed_unet"], "outputs"),
        pytest.param(["name=a,b"], "outputs", marks=pytest.mark.slow),
        pytest.param(["model=unit,projected"], "outputs/custom", marks=pytest.mark.slow),
    ],
)
def test_a_sweep_has_one_folder(in_hydra: None, overrides: list[str], parent: str) -> None:
    folder = sweep("scale=test", *overrides)
    assert folder.parent == Path(parent) and folder.name.startswith("multirun_")
    assert len(sweep_jobs.read(folder)) == 2


@pytest.mark.slow
def test_two_sweeps_in_one_second_have_two_folders(in_hydra: None) -> None:
    now = "hydra.sweep.dir=${paths.outputs}/${name}/multirun_now"
    assert sweep("scale=test", "seed=1,2", now) == sweep("scale=test", "seed=1,2", now)  # set by the user
    folders = {sweep("scale=test", "seed=1,2") for _ in range(3)}
    assert len(folders) == 3


def test_a_folder_of_a_run_is_no_folder_of_a_sweep(in_hydra: None, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / COMPOSED).touch()
    with pytest.raises(SystemExit, match="2"):
        sweep("scale=test", "seed=1,2", "hydra.sweep.dir=run")


@pytest.mark.parametrize(
    "value", ["a/b-1.c", "my runs", "it's", "a,b", "x=1", "1", "null", "back\\slash'", "${x}", "ü"]
)
def test_shown_overrides_can_be_parsed(value: str) -> None:
    (parsed,) = OverridesParser.create().parse_overrides([assignment("resume", value)])
    assert str(parsed.value()).replace("\\${", "${") == value


@pytest.mark.parametrize(
    "words", [["--help"], ["--cfg", "job"], ["--cfg", "hydra"], ["hydra.job.chdir=true"]]
)
def test_commands_that_write_nothing_create_no_folder(
    command: Command, tmp_path: Path, words: list[str]
) -> None:
    command("train", *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_run_in_a_given_folder(command: Command, command_in_process: Command, tmp_path: Path) -> None:
    words = [*JOB, "trainer.fast_dev_run=true", "hydra.run.dir=my run"]
    done = command("train", *words[:-1], "hydra.run.dir='my run'")
    assert done.returncode == 0, done.stderr
    run = tmp_path / "my run"
    assert {"tables", ".hydra", "final.json", "config.yaml"} <= {path.name for path in run.iterdir()}
    assert (tmp_path / "outputs" / "chair_unet" / "latest").resolve() == run
    assert [path.name for path in (tmp_path / "outputs" / "chair_unet").iterdir()] == ["latest"]
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    again = command_in_process("train", *words[:-1], "hydra.run.dir='my run'")
    assert again.returncode == 2 and "hydra.run.dir: got my run" in again.stderr
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before
    moved = command_in_process("train", "resume=latest", "hydra.run.dir=other")
    assert moved.returncode == 2 and "hydra.run.dir: got" in moved.stderr
