"""Sweeps of independent jobs: a failed job does not stop the others; a summary at the end lists the failed jobs.

`hydra.sweep.dir=<folder of an earlier sweep>` runs the jobs of that sweep that are missing, failed or stopped; jobs
with a checkpoint resume from it. Several processes may run the same sweep at once and divide the jobs among them.
"""

import shlex
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from imagination.config.compose import compose
from imagination.config.key_roles import Role
from imagination.config.overrides import assignment, override_key
from imagination.config.plugin_registry import activate
from imagination.config.user_messages import explain, user_errors_reported
from imagination.config.validation import validate
from imagination.runs import sweep_jobs
from imagination.runs.command_line import command_line, own_arguments
from imagination.runs.final_record import read_final_record
from imagination.runs.folder import COMPOSED, check_links, create_folder
from imagination.runs.locking import BusyError, locked
from imagination.utils import interrupts
from imagination.utils.errors import UserError
from imagination.utils.timing import stage_timer

SWEEP_KEYS = ("sweep", "hparams_search")
"""Keys of overrides that select the jobs of a sweep and are no overrides of a job."""

FOLDER_KEY = "hydra.sweep.dir"
"""Key of the folder of a sweep."""


class _Job(NamedTuple):
    """Job of a sweep before it is registered."""

    key: str
    name: str
    overrides: list[str]


class Sweep(Callback):
    """Hydra callback that registers the jobs of a sweep before it starts and summarizes them at the end."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Create the folder and register all jobs; a hyperparameter search registers each job when it starts."""
        search = not config.hydra.sweeper._target_.endswith(f".{BasicSweeper.__name__}")
        with user_errors_reported():
            jobs = [] if search else expand_jobs(config.hydra, str(kwargs["config_name"]))
            folder = sweep_folder(config, {job.name for job in jobs})
            check_links(folder)
            config.hydra.sweep.dir = str(folder)
            # Hydra composes the config of each job from these overrides
            config.hydra.overrides.hydra.append(assignment(FOLDER_KEY, str(folder)))
            for job in jobs:
                sweep_jobs.register(folder, job.key, job.overrides)
        _Running.command = remaining_jobs_command(config)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Print the failed jobs and the command that runs the remaining ones; exit with code 1 if a job failed."""
        folder = Path(config.hydra.sweep.dir)
        jobs = sweep_jobs.read(folder)
        done = sum(job.state == "done" for job in jobs)
        print(
            f"Sweep {folder}: {done} of {len(jobs)} jobs done ({folder / sweep_jobs.FILE})",
            file=sys.stderr,
        )
        failed = [job for job in jobs if job.state == "failed"]
        for job in failed:
            print(f"  {job.folder} failed ({job.overrides}): {job.problem}", file=sys.stderr)
        if done < len(jobs):
            print(f"Run the remaining jobs: {remaining_jobs_command(config)}", file=sys.stderr)
        if failed:
            sys.exit(1)


class _Running:
    """Sweep that this process runs: the command that continues it."""

    command: str | None = None


@contextmanager
def interruption_reported() -> Iterator[None]:
    """Report how to continue a sweep that was interrupted in this context."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        if interrupts.received() and _Running.command:
            interrupts.report(f"Run the remaining jobs: {_Running.command}")
        raise


def remaining_jobs_command(config: DictConfig) -> str:
    """Return the command that runs the remaining jobs of a sweep."""
    arguments = own_arguments(without=[FOLDER_KEY])
    folder = assignment(FOLDER_KEY, str(config.hydra.sweep.dir))
    return command_line(config.hydra.job.name, [*arguments, folder])


def sweep_folder(config: DictConfig, names: set[str]) -> Path:
    """Return the folder of a sweep, which is created unless the user has set it.

    Args:
        config: config of the sweep, with its `hydra` node.
        names: names of the experiments of its jobs. Several experiments share outputs/multirun_<date_time>.

    Raises:
        UserError: if the user has set the folder of a run.
    """
    folder = Path(config.hydra.sweep.dir)
    if any(override_key(text) == FOLDER_KEY for text in config.hydra.overrides.hydra):
        if (folder / COMPOSED).exists():
            raise UserError(
                f"{FOLDER_KEY}: got {folder}, which is the folder of a run, expected a new folder or that of a sweep"
            )
        return folder
    several = len(names | {config.name}) > 1 and folder.parent.name == config.name
    return create_folder(Path(config.paths.outputs) if several else folder.parent, folder.name)


def expand_jobs(hydra: DictConfig, config_name: str) -> list[_Job]:
    """Return all jobs of a sweep over lists of values.

    Args:
        hydra: `hydra` node of the config.
        config_name: name of the command.

    Raises:
        UserError: if a value of a job is out of range, or two jobs would train the same unit and differ only in the
            evaluation.
    """
    arguments = [
        *(f"{key}={value}" for key, value in (hydra.sweeper.params or {}).items()),
        *hydra.overrides.task,
    ]
    parsed = OverridesParser.create(GlobalHydra.instance().config_loader()).parse_overrides(arguments)
    key_by_training: dict[str, str] = {}  # key of the first job with each training configuration
    jobs = []
    for job_arguments in BasicSweeper.split_arguments(parsed, None)[0]:
        config, overrides = compose(config_name, list(job_arguments)), job_overrides(job_arguments)
        validate(config)
        key = sweep_jobs.config_key(config)
        training = sweep_jobs.config_key(config, {Role.EVALUATION})
        first_key = key_by_training.setdefault(training, key)
        if config_name == "train" and first_key != key:
            raise UserError(
                f"sweep: got {shlex.join(overrides)}, which differs from another job only in the evaluation; train "
                "once, then sweep the evaluation with python -m imagination.evaluate -m ckpt=…"
            )
        jobs.append(_Job(key, config.name, overrides))
    return jobs


def job_overrides(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that configure a job, without those that configure the sweep."""
    return [text for text in overrides if override_key(text) not in SWEEP_KEYS]


def run_job(task: Callable[[DictConfig], float | None], config: DictConfig) -> float | None:
    """Run one job in its folder, `paths.run`, and return its score; an error is printed and recorded, not raised."""
    activate()  # a launcher may have started this process without plugins
    interrupts.install()
    hydra = HydraConfig.get()
    sweep, key = Path(hydra.sweep.dir), sweep_jobs.config_key(config)
    overrides = job_overrides(list(hydra.overrides.task))
    job = sweep_jobs.register(sweep, key, overrides)
    try:
        with locked(sweep, sweep_jobs.lock_name(job)):
            job = sweep_jobs.register(sweep, key, overrides)  # another process may have finished it
            if job.state == "done":
                return float(job.score) if job.score else None
            print(f"Job {job.folder}: {job.overrides}", file=sys.stderr)
            if (record := read_final_record(sweep / job.folder)) is not None:  # killed after it had finished
                score = record.get("score")
            else:
                sweep_jobs.update(sweep, key, state="running", problem="")
                stage_timer.restart()
                config.paths.run = str(sweep / job.folder)
                validate(config)
                score = task(config)
            sweep_jobs.update(sweep, key, state="done", score="" if score is None else repr(score))
            return score
    except BusyError as error:
        print(f"Job {job.folder} is skipped: {error}", file=sys.stderr)
    except (KeyboardInterrupt, SystemExit):
        with interrupts.postponed():
            sweep_jobs.update(sweep, key, state="stopped")
        raise
    except Exception as error:
        problem = explain(error)
        if problem is None:
            traceback.print_exc()
            problem = f"{type(error).__name__}: {error}"
        print(f"error: {problem}", file=sys.stderr)
        sweep_jobs.update(sweep, key, state="failed", problem=" ".join(problem.split()))
    return None
