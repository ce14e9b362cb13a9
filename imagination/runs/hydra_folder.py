"""Hydra's output folder `hydra.run.dir`, which a command creates itself once its config has been checked.

Hydra would create the folder before the command starts: also for a config that is refused, for a run that resumes in
its own folder, and for two runs that start in the same second.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from imagination.config.overrides import override_key, sweeps
from imagination.runs.final_record import FINAL
from imagination.runs.folder import COMPOSED, CONFIG, create_folder
from imagination.utils.atomic_io import write_errors_reported, write_text
from imagination.utils.errors import UserError

HYDRA = ".hydra"
"""Folder in a run folder with the config, the overrides and Hydra's own config, as Hydra writes it."""

DEFAULT = re.compile(r"\$\{paths\.outputs\}/\$\{name\}/[^/]+")
"""Pattern of a `hydra.run.dir` that is a new folder in the folder of the experiment."""

FIXED = {
    "hydra.output_subdir": f"null, because run folders always contain {HYDRA}/",
    "hydra.sweep.subdir": "no such key, because jobs are numbered as in jobs.csv",
    "hydra.job.chdir": "false, because paths are relative to the current folder",
}
"""Keys of Hydra that keep their value, with what is expected."""


class DelayedRunFolder(Callback):
    """Hydra callback that keeps Hydra from creating the run folder."""

    def __init__(self) -> None:
        self._run_dir: str | None = None

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Hide the folder from Hydra."""
        self._run_dir = _unresolved(config.hydra.run)
        config.hydra.run.dir = "."

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Show the folder to the command."""
        if self._run_dir is not None:
            _set_hydra("run.dir", self._run_dir)


WITH_RUN_FOLDER = ("train", "evaluate", "study", "map", "serve")
"""Commands that have a run folder."""


def check_hydra_overrides(command: str, words: Sequence[str]) -> None:
    """Refuse overrides of Hydra's folders that would have no effect.

    Args:
        command: name of the command, such as "train".
        words: words of a command line.

    Raises:
        UserError: on the first such override.
    """
    is_sweep = any(map(sweeps, words))
    for text in words:
        value = text.partition("=")[2]
        if override_key(text) == "hydra.sweep.dir" and not is_sweep:
            raise UserError(
                f"hydra.sweep.dir: got {value!r} without -m, expected a sweep; add -m or leave it out"
            )
        if override_key(text) == "hydra.run.dir" and is_sweep:
            raise UserError(f"hydra.run.dir: got {value!r} for a sweep; set hydra.sweep.dir instead")
        if override_key(text) == "hydra.run.dir" and command not in WITH_RUN_FOLDER:
            raise UserError(
                f"hydra.run.dir: got {value!r}, but imagination.{command} has no run folder; leave it out"
            )
        if (expected := FIXED.get(override_key(text))) and value not in ("null", "false", "False"):
            raise UserError(f"{override_key(text)}: got {value!r}, expected {expected}; leave it out")


def new_run_folder(config: DictConfig, *, continues: bool = False) -> Path:
    """Create the folder of a new run, `hydra.run.dir`, or return it if it exists and holds no run.

    Args:
        config: config of the command, with `name` and `paths.outputs`.
        continues: whether the command may continue in the folder of an unfinished run.

    Raises:
        UserError: if the folder holds a run.
    """
    folder = Path(HydraConfig.get().run.dir)
    if DEFAULT.fullmatch(_unresolved(HydraConfig.get().run)):
        folder = create_folder(experiment_folder(config), folder.name)
    else:
        check_holds_no_run(folder, continues=continues)
        with write_errors_reported(folder):
            folder.mkdir(parents=True, exist_ok=True)
    describe_run(folder, config)
    return folder


def experiment_folder(config: DictConfig) -> Path:
    """Return the folder of all runs of an experiment, which contains the `latest` symlink."""
    folder: Path = Path(config.paths.outputs) / config.name
    return folder


def check_holds_no_run(folder: Path, *, continues: bool = False) -> None:
    """Refuse a folder for a new run that holds another run.

    Args:
        folder: folder for the new run.
        continues: whether an unfinished run is accepted, except of a training.

    Raises:
        UserError: if the folder holds a run.
    """
    files = (COMPOSED, FINAL) if continues else (COMPOSED, CONFIG, FINAL)
    if found := [name for name in files if (folder / name).exists()]:
        resume = f"resume it with resume={folder}, or " if (folder / COMPOSED).exists() else ""
        raise UserError(
            f"hydra.run.dir: got {folder}, which already holds a run ({found[0]}), expected a new folder; {resume}"
            "choose another folder"
        )


def describe_run(folder: Path, config: DictConfig) -> None:
    """Write .hydra/ into a run folder, unless it is there, and let Hydra's config name the folder."""
    if HydraConfig.get().mode == RunMode.RUN:
        _set_hydra("run.dir", str(folder))
    _set_hydra("runtime.output_dir", str(folder.resolve()))
    if (folder / HYDRA).exists():
        return
    hydra = HydraConfig.instance().cfg
    write_text(folder / HYDRA / "config.yaml", OmegaConf.to_yaml(config))
    write_text(folder / HYDRA / "hydra.yaml", OmegaConf.to_yaml(hydra))
    write_text(folder / HYDRA / "overrides.yaml", OmegaConf.to_yaml(HydraConfig.get().overrides.task))


def _unresolved(run: Any) -> str:
    """Return `hydra.run.dir` with its interpolations."""
    values: Any = OmegaConf.to_container(run, resolve=False)
    return str(values["dir"])


def _set_hydra(key: str, value: str) -> None:
    hydra: Any = HydraConfig.instance().cfg
    with read_write(hydra.hydra), open_dict(hydra.hydra):
        OmegaConf.update(hydra, f"hydra.{key}", value)
