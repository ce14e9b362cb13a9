"""Sweeps of independent jobs: a failed job does not stop the others; a summary at the end lists the failed jobs.

`sweep_dir=<folder of an earlier sweep>` runs the jobs of that sweep that are missing, failed or stopped; jobs with a
checkpoint resume from it. Several processes may run the same sweep at once and divide the jobs among them.
"""

import shlex
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from imagination.config.compose import compose
from imagination.config.key_roles import Role
from imagination.config.overrides import override_key
from imagination.config.plugin_registry import activate
from imagination.config.user_messages import explain, user_errors_reported
from imagination.config.validation import validate
from imagination.runs import sweep_jobs
from imagination.runs.folder import check_links, resolved_path
from imagination.runs.locking import BusyError, locked
from imagination.utils.errors import UserError
from imagination.utils.timing import stage_timer

SWEEP_KEYS = ("sweep", "hparams_search", "sweep_dir")
"""Keys of overrides that select the jobs of a sweep and are no overrides of a job."""


class Sweep(Callback):
    """Hydra callback that registers the jobs of a sweep before it starts and summarizes them at the end."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Register all jobs before the first one starts; a hyperparameter search registers each job when it starts."""
        with user_errors_reported():
            check_links(Path(config.hydra.sweep.dir))
        if config.hydra.sweeper._target_.endswith(f".{BasicSweeper.__name__}"):
            with user_errors_reported():
                register_jobs(config.hydra, str(kwargs["config_name"]))

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
            arguments = [
                _permanent_argument(text) for text in sys.argv[1:] if not text.startswith("sweep_dir=")
            ]
            command = shlex.join(["python", "-m", f"imagination.{config.hydra.job.name}", *arguments])
            print(f"Run the remaining jobs: {command} sweep_dir={folder}", file=sys.stderr)
        if failed:
            sys.exit(1)


def _permanent_argument(text: str) -> str:
    """Resolve the symlinks in a `ckpt` argument, because `latest` may point to another run later."""
    path = Path(text.removeprefix("ckpt="))
    return f"ckpt={resolved_path(path)}" if text.startswith("ckpt=") and path.is_file() else text


def register_jobs(hydra: DictConfig, config_name: str) -> None:
    """Register all jobs of a sweep over lists of values.

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
        jobs.append((key, overrides))
    for key, overrides in jobs:
        sweep_jobs.register(Path(hydra.sweep.dir), key, overrides)


def job_overrides(overrides: list[str]) -> list[str]:
    """Return the overrides that configure a job, without those that configure the sweep."""
    return [text for text in overrides if override_key(text) not in SWEEP_KEYS]


def run_job(task: Callable[[DictConfig], float | None], config: DictConfig) -> float | None:
    """Run one job in its folder, `paths.run`, and return its score; an error is printed and recorded, not raised."""
    activate()  # a launcher may have started this process without plugins
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
        sweep_jobs.update(sweep, key, state="stopped")
        print(
            f"The sweep was stopped; to continue, add sweep_dir={sweep} to the same command line",
            file=sys.stderr,
        )
        raise
    except Exception as error:
        problem = explain(error)
        if problem is None:
            traceback.print_exc()
            problem = f"{type(error).__name__}: {error}"
        print(f"error: {problem}", file=sys.stderr)
        sweep_jobs.update(sweep, key, state="failed", problem=" ".join(problem.split()))
    return None
