"""Which run a command line asks for: a new one, or one to go on with in its folder."""

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

from imagination.config.overrides import choices, key
from imagination.config.trust import check_targets
from imagination.config.user_messages import explain
from imagination.config.validation import validate
from imagination.runs.distributed import agree, end_with_starter, lost_another
from imagination.runs.folder import (
    COMPOSED,
    CONFIG,
    LAST,
    create_folder,
    find_latest,
    now,
    point_latest,
    take_back_latest,
    within,
)
from imagination.runs.locking import locked
from imagination.runs.logging import FILE_ONLY, logging_to
from imagination.utils.atomic_io import remove_parts, write_errors_reported, write_text
from imagination.utils.cache import code_version
from imagination.utils.errors import UserError, WorkerDiedError
from imagination.utils.process_group import global_rank
from imagination.utils.progress import console

log = logging.getLogger(__name__)

MAY_CHANGE = (
    *("trainer.max_epochs", "trainer.accelerator", "trainer.devices", "trainer.num_nodes", "paths."),
    "scale.workers",  # what they compute does not depend on their number
    "data.shards",  # a corpus may move; that it is of the same kind is checked when it is read
)
"""What may be overridden when a run goes on; all else is the run's own, and may only be said again."""


PROGRAM = (
    *("callbacks", "data", "geometry", "ground_truth", "models", "scenes", "views"),
    *("utils/precision.py", "utils/process_group.py"),
)
"""Packages and modules whose code decides what a training makes."""

END = "...\n"
"""Last line of a run's composed config, YAML's mark of a document's end: without it the file was cut."""


class Run(NamedTuple):
    """A run that this process holds.

    Attributes:
        folder: its own.
        config: composed, with `paths.run` set.
        checkpoint: to go on from; None to begin.
        before: name of the folder that `latest` pointed to before this run began.
    """

    folder: Path
    config: DictConfig
    checkpoint: Path | None
    before: str | None = None


@contextmanager
def opened(config: DictConfig) -> Iterator[Run]:
    """The run that a command line asks for, locked and with its log, until the end.

    Raises:
        UserError: if there is nothing to go on with, or it may not be changed like this.
    """
    asked = config.resume or config.ckpt_path
    if global_rank():
        run = _joined(config)
        try:
            yield run
        except Exception as error:
            if lost_another(error):
                raise lost(run.folder) from error
            raise
        return
    folder = _existing(config) if asked else _new(config)
    agree(folder)
    with locked(folder), logging_to(folder / "run.log"):
        if asked:
            _check_changes(folder, config)
        going_on = asked or (folder / COMPOSED).is_file()  # of a sweep's member that has not ended
        remove_parts(folder)
        run = _go_on(folder, config) if going_on else _begin(folder, config)
        try:
            yield run
        except Exception as error:
            log.error("The run failed", exc_info=True, extra=FILE_ONLY)
            if "torch" in sys.modules and lost_another(error):
                raise lost(folder) from error
            if isinstance(error, WorkerDiedError):  # nothing is wrong with the run
                alone = HydraConfig.get().mode != RunMode.MULTIRUN
                hint = again(folder) if alone else f"start the sweep again with sweep_dir={folder.parent}"
                raise WorkerDiedError(f"{error}; {hint}") from error
            if explain(error) and not (folder / LAST).is_file():  # refused: nothing to go on with
                take_back_latest(folder, run.before)
            raise
        except (KeyboardInterrupt, SystemExit) as stop:
            if not _pressed(stop):
                raise
            last = folder / LAST
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                log.warning("Interrupted")
            elif last.is_file():
                log.warning("Interrupted. Go on with: python -m imagination.train ckpt_path=%s", last)
            else:
                log.warning("Interrupted before a round was finished; start again with the same arguments")
            raise SystemExit(130) from stop


def _joined(config: DictConfig) -> Run:
    """The run that the first of several processes has opened; it alone writes and speaks."""
    console.quiet = True
    logging.getLogger().setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    Thread(target=end_with_starter, daemon=True).start()
    folder = agree()
    if config.resume or config.ckpt_path:
        return _go_on(folder, config)
    config.paths.run = str(folder)
    config.choices = choices(HydraConfig.get().overrides.task)
    return Run(folder, config, None)


def lost(folder: Path) -> UserError:
    """What to tell when another of several processes is gone."""
    return UserError(
        f"training: another of the processes that train together is gone, so the job stops; {again(folder)}"
    )


def again(folder: Path) -> str:
    """What to do about a run that ended through no fault of its own."""
    last = folder / LAST
    if last.is_file():
        return f"go on with the same command and ckpt_path={last}"
    return "no round was finished, so start the same command again"


def _new(config: DictConfig) -> Path:
    """A new run's folder, outputs/<name>/<date_time>; that of a sweep's member is given, and may be there already."""
    job = HydraConfig.get().mode == RunMode.MULTIRUN
    config.paths.run = config.paths.run if job else "."
    OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # fails before there is a folder
    if job:
        folder = Path(config.paths.run)
        with write_errors_reported(folder):
            folder.mkdir(parents=True, exist_ok=True)
        return folder
    return create_folder(Path(config.paths.outputs) / config.name, now())


def _begin(folder: Path, config: DictConfig) -> Run:
    config.paths.run = str(folder)
    config.choices, config.program = choices(HydraConfig.get().overrides.task), code_version(PROGRAM)
    write_text(folder / COMPOSED, OmegaConf.to_yaml(config) + END)
    write_text(folder / CONFIG, OmegaConf.to_yaml(config, resolve=True))
    alone = HydraConfig.get().mode != RunMode.MULTIRUN
    return Run(folder, config, None, point_latest(folder) if alone else None)


def _existing(config: DictConfig) -> Path:
    """The folder of the run to go on with."""
    if config.ckpt_path:
        path = Path(config.ckpt_path)
        if not path.is_file():
            raise UserError(f"ckpt_path: got {path}, but there is no such file")
        folder = within(path.resolve().parent.parent)
        if not (folder / COMPOSED).is_file():
            raise UserError(
                f"ckpt_path: got {path}, which lies in no run's folder ({folder / COMPOSED} is missing); to use "
                f"its weights: python -m imagination.evaluate ckpt={path}"
            )
        return folder
    if config.resume != "latest":
        raise UserError(f"resume: got {config.resume!r}, expected latest; name a checkpoint with ckpt_path=…")
    experiment = config.name if "experiment" in HydraConfig.get().runtime.choices else None
    return find_latest(Path(config.paths.outputs), experiment)


def _check_changes(folder: Path, config: DictConfig) -> None:
    """Refuse overrides that would make another run of the one in `folder`; what it has already may be said again."""
    allowed, saved = ("resume=", "ckpt_path=", "experiment=", *MAY_CHANGE), _read(folder / COMPOSED)

    def changes(text: str) -> bool:
        if text.lstrip("+").startswith(allowed) or text in saved.choices:
            return False
        name = key(text)
        return "/" in name or "@" in name or OmegaConf.select(config, name) != OmegaConf.select(saved, name)

    if refused := [text for text in HydraConfig.get().overrides.task if changes(text)]:
        raise UserError(
            f"resume: got {' '.join(refused)}, but a run goes on with its own config; only "
            f"{', '.join(MAY_CHANGE)} may change"
        )


def _go_on(folder: Path, config: DictConfig) -> Run:
    """The run in `folder` with its own config, and what may be changed of it."""
    saved = _read(folder / COMPOSED)
    if "experiment" in HydraConfig.get().runtime.choices and config.name != saved.name:
        raise UserError(
            f"resume: got the experiment {config.name!r}, but the run in {folder} is of {saved.name!r}"
        )
    overrides = HydraConfig.get().overrides.task
    changes = [text.lstrip("+") for text in overrides if text.lstrip("+").startswith(MAY_CHANGE)]
    for name in (text.partition("=")[0] for text in changes):
        OmegaConf.update(saved, name, OmegaConf.select(config, name))
    saved.paths.run = str(folder)
    if OmegaConf.select(saved, "program") != code_version(PROGRAM):
        log.warning("%s: the program has changed since this run began; it goes on with today's", folder)
    checkpoint = Path(config.ckpt_path) if config.ckpt_path else folder / LAST
    if not checkpoint.is_file():
        log.warning("%s: no round was finished, so the run begins anew with its own config", folder)
        return Run(folder, saved, None, folder.name)
    return Run(folder, saved, checkpoint, folder.name)


def _read(path: Path) -> DictConfig:
    """A run's composed config, checked."""
    try:
        text = path.read_text()
        if not text.endswith(END):
            raise UserError(
                f"config {path}: is truncated, its last line is not {END.strip()!r}; start a new run"
            )
        saved = OmegaConf.create(text)
        assert isinstance(saved, DictConfig)
        OmegaConf.set_struct(saved, True)
        validate(saved)
        check_targets(saved)
    except UserError:
        raise
    except Exception as error:  # yaml raises anything on what looks like a date or a number
        raise UserError(f"config {path}: is truncated or damaged ({error}); start a new run") from error
    return saved


def _pressed(stop: BaseException) -> bool:
    """Whether Ctrl-C is behind it: Lightning turns it into SystemExit."""
    return isinstance(stop, KeyboardInterrupt) or isinstance(stop.__context__, KeyboardInterrupt)
