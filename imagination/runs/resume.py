"""Start of a new training run, or resumption of an existing one in its folder."""

import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import NamedTuple

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from imagination.config.key_roles import KEYS, Role, is_resumable, role
from imagination.config.overrides import assignment, override_key, result_overrides
from imagination.config.trust import check_targets
from imagination.config.unknown_keys import is_group
from imagination.config.user_messages import explain
from imagination.config.written_paths import check_paths
from imagination.runs.command_line import command_line
from imagination.runs.composed_config import keep_references, read_composed_config, write_composed_config
from imagination.runs.distributed import exit_with_parent, is_process_lost, share_run_folder
from imagination.runs.final_record import remove_final_record
from imagination.runs.folder import (
    COMPOSED,
    CONFIG,
    LAST,
    LOG,
    check_links,
    find_latest,
    point_latest,
    resolved_path,
    restore_latest,
)
from imagination.runs.hydra_folder import (
    check_holds_no_run,
    describe_run,
    experiment_folder,
    new_run_folder,
)
from imagination.runs.locking import locked
from imagination.runs.logging import FILE_ONLY, logging_to
from imagination.runs.program import program
from imagination.utils import interrupts
from imagination.utils.atomic_io import remove_parts, write_errors_reported, write_text
from imagination.utils.errors import UserError, WorkerDiedError
from imagination.utils.process_group import global_rank
from imagination.utils.progress import console

log = logging.getLogger(__name__)


class Run(NamedTuple):
    """A training run.

    Attributes:
        folder: run folder.
        config: composed config, with `paths.run` set.
        checkpoint: checkpoint to resume from; None to start from the beginning.
        previous_latest: run folder that `latest` pointed to before.
    """

    folder: Path
    config: DictConfig
    checkpoint: Path | None
    previous_latest: Path | None = None


@contextmanager
def open_run(config: DictConfig) -> Iterator[Run]:
    """Start or resume the run of a config; the folder is locked and the messages are logged to it.

    Raises:
        UserError: if there is no run to resume, or an override would change it.
    """
    resume_requested = config.resume or config.ckpt_path
    if global_rank():
        run = join_run(config)
        try:
            yield run
        except Exception as error:
            if is_process_lost(error):
                raise lost_process_error(run.folder) from error
            raise
        return
    folder = existing_run_folder(config) if resume_requested else create_run_folder(config)
    check_links(folder)
    share_run_folder(folder)
    with locked(folder), logging_to(folder / LOG), interruption_reported(folder):
        if resume_requested:
            check_changes(folder, config)
        elif not in_sweep():
            check_holds_no_run(folder)  # another process may have had the lock
        resuming = resume_requested or (folder / COMPOSED).is_file()  # unfinished job of a sweep
        remove_parts(folder)
        run = resume_run(folder, config) if resuming else begin_run(folder, config)
        if run.config.train:
            remove_final_record(folder)
        describe_run(folder, run.config)
        try:
            yield run
        except Exception as error:
            if interrupts.received():  # the error is a consequence, such as a lost connection
                raise
            if (failure := explained_failure(error, run)) is not error:
                raise failure from error
            raise


@contextmanager
def interruption_reported(folder: Path) -> Iterator[None]:
    """Report how to resume an interrupted run, and exit; a sweep tells how to run its remaining jobs."""
    try:
        yield
    except BaseException as error:
        # not only a KeyboardInterrupt: Lightning turns it into a SystemExit
        if not interrupts.received() or not (folder / COMPOSED).is_file():
            raise
        with interrupts.postponed():
            if in_sweep():
                log.info("Interrupted", extra=FILE_ONLY)
            else:
                interrupts.report(f"Resume with: {resume_command(folder)}")
        raise SystemExit(interrupts.exit_code()) from error


def explained_failure(error: Exception, run: Run) -> Exception:
    """Return the error that ends a run, with the way to resume the run if the error has an external cause."""
    log.error("The run failed", exc_info=True, extra=FILE_ONLY)
    if "torch" in sys.modules and is_process_lost(error):
        return lost_process_error(run.folder)
    if isinstance(error, WorkerDiedError):  # the run itself is sound
        hint = sweep_hint(run.folder) if in_sweep() else resume_hint(run.folder)
        return WorkerDiedError(f"{error}; {hint}")
    if explain(error) and not (run.folder / LAST).is_file():  # a user error, and nothing to resume
        restore_latest(run.folder, run.previous_latest, experiment_folder(run.config))
    return error


def in_sweep() -> bool:
    """Return whether the current run is a job of a sweep."""
    return HydraConfig.get().mode == RunMode.MULTIRUN


def join_run(config: DictConfig) -> Run:
    """Return the run that rank 0 has opened; other ranks write no files and show no messages."""
    console.quiet = True
    logging.getLogger().setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    Thread(target=exit_with_parent, daemon=True).start()
    folder = share_run_folder()
    if config.resume or config.ckpt_path:
        return resume_run(folder, config)
    config.paths.run = str(folder)
    config.choices = result_overrides(HydraConfig.get().overrides.task, config)
    return Run(folder, config, None)


def lost_process_error(folder: Path) -> UserError:
    """Return the error for a training process that has ended, with the way to resume the run."""
    return UserError(f"training: another training process has ended, so the job stops; {resume_hint(folder)}")


def resume_hint(folder: Path) -> str:
    """Return the advice to resume a run that was ended by an external cause."""
    return f"resume with: {resume_command(folder)}"


def resume_command(folder: Path) -> str:
    """Return the command that resumes a run with the changes of this command."""
    return command_line("train", [assignment("resume", str(folder)), *changes_of_this_command()])


def changes_of_this_command() -> list[str]:
    """Return the overrides of a command that resumes a run, which the config of the run does not contain."""
    overrides = list(HydraConfig.get().overrides.task)
    if not any(override_key(text) in ("resume", "ckpt_path") for text in overrides):
        return []
    keys = {text: override_key(text) for text in overrides}
    return [text for text, key in keys.items() if is_resumable(key) and role(key) != Role.COMMAND]


def sweep_hint(folder: Path) -> str:
    """Return the advice to resume a job of a sweep that was ended by an external cause."""
    return f"start the sweep again with hydra.sweep.dir={folder.parent}"


def create_run_folder(config: DictConfig) -> Path:
    """Return the folder of a new run, `hydra.run.dir`; for a job of a sweep it is given and may exist."""
    config.paths.run = config.paths.run if in_sweep() else "."
    OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # fails before a folder is created
    if in_sweep():
        folder = Path(config.paths.run)
        with write_errors_reported(folder):
            folder.mkdir(parents=True, exist_ok=True)
        describe_run(folder, config)
        return folder
    return new_run_folder(config)


def begin_run(folder: Path, config: DictConfig) -> Run:
    """Write the config of a new run into its folder and return the run."""
    config.paths.run = str(folder)
    config.choices = result_overrides(HydraConfig.get().overrides.task, config)
    config.program = program(config)
    try:
        check_targets(config)
    except UserError as error:
        log.warning("%s. This run can be trained, but not resumed", error)
    write_composed_config(folder / COMPOSED, config)
    write_text(folder / CONFIG, OmegaConf.to_yaml(config, resolve=True))
    if in_sweep():
        return Run(folder, config, None)
    return Run(folder, config, None, point_latest(folder, experiment_folder(config)))


def existing_run_folder(config: DictConfig) -> Path:
    """Return the folder of the run to resume.

    Raises:
        UserError: if there is no such run.
    """
    if given := [text for text in HydraConfig.get().overrides.hydra if override_key(text) == "hydra.run.dir"]:
        raise UserError(f"hydra.run.dir: got {given[0]}, but a run resumes in its own folder; leave it out")
    if config.ckpt_path:
        path = Path(config.ckpt_path)
        if not path.is_file():
            raise UserError(f"ckpt_path: got {path}, but there is no such file")
        folder = resolved_path(path.resolve().parent.parent)
        if not (folder / COMPOSED).is_file():
            raise UserError(
                f"ckpt_path: got {path}, expected a checkpoint in a run folder ({folder / COMPOSED} is missing); to "
                f"evaluate its weights: python -m imagination.evaluate ckpt={path}"
            )
        return folder
    if config.resume != "latest":
        if not (Path(config.resume) / COMPOSED).is_file():
            raise UserError(
                f"resume: got {config.resume!r}, expected latest or a run folder ({COMPOSED} is missing there)"
            )
        return resolved_path(Path(config.resume))
    experiment = config.name if HydraConfig.get().runtime.choices.get("experiment") else None
    return find_latest(Path(config.paths.outputs), experiment)


def check_changes(folder: Path, config: DictConfig) -> None:
    """Check that the overrides do not change the config of the run in `folder`; equal overrides are allowed.

    Raises:
        UserError: if an override changes a value that may not change.
    """
    saved = read_composed_config(folder / COMPOSED)

    def changes(text: str) -> bool:
        key = override_key(text)
        if key == "experiment" or is_resumable(key) or text in saved.choices:
            return False
        overlay = is_group(key) and key not in config  # such as a scale, which sets keys of other nodes
        if overlay or "/" in key or "@" in key:
            return True
        return bool(OmegaConf.select(config, key) != OmegaConf.select(saved, key))

    if refused := [text for text in HydraConfig.get().overrides.task if changes(text)]:
        allowed = ", ".join(key for key, row in KEYS.items() if row.resumable)
        raise UserError(
            f"resume: got {' '.join(refused)}, but a resumed run keeps its config; only {allowed} may change; remove "
            "the override, or start a new run"
        )


def resume_run(folder: Path, config: DictConfig) -> Run:
    """Return the run in `folder` with its saved config, the allowed changes, and the paths and cache of the command.

    Raises:
        UserError: if the run belongs to another experiment, or its config cannot be read.
    """
    saved = read_composed_config(folder / COMPOSED)
    if HydraConfig.get().runtime.choices.get("experiment") and config.name != saved.name:
        raise UserError(
            f"resume: got the experiment {config.name!r}, expected {saved.name!r} for the run in {folder}"
        )
    overrides = HydraConfig.get().overrides.task
    for key in filter(is_resumable, map(override_key, overrides)):
        if role(key) not in (Role.COMMAND, Role.LOCATION):
            keep_references(saved, key)
            OmegaConf.update(saved, key, OmegaConf.select(config, key))
    config.paths.run = str(folder)
    if saved.paths.cache != config.paths.cache:
        log.warning(
            "paths.cache: got %s, not the %s of the saved config", config.paths.cache, saved.paths.cache
        )
    # a file does not choose where to write
    saved.paths, saved.cache = OmegaConf.merge(saved.paths, config.paths), config.cache
    check_paths(saved, config)
    if OmegaConf.select(saved, "program") != program(saved):
        log.warning("%s: the program has changed since the start of this run", folder)
    checkpoint = Path(config.ckpt_path) if config.ckpt_path else folder / LAST
    if not checkpoint.is_file():
        log.warning("%s: no epoch was completed, so the run starts from the beginning", folder)
        return Run(folder, saved, None, folder)
    return Run(folder, saved, checkpoint, folder)
