"""Sweeps: each member runs for itself, a mistake in one stops no other, and the end tells which failed and why.

`sweep_dir=<folder of an earlier sweep>` runs the members that are missing there, failed or were stopped; those that
have a checkpoint go on from it. Started twice at once, two processes share a sweep's members.
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
from imagination.config.overrides import key
from imagination.config.plugin_registry import activate
from imagination.config.user_messages import explain, user_errors_reported
from imagination.config.validation import validate
from imagination.runs import sweep_jobs
from imagination.runs.folder import within
from imagination.runs.locking import BusyError, locked
from imagination.utils.errors import UserError
from imagination.utils.timing import shares

STEERING = ("sweep", "hparams_search", "sweep_dir")
"""Overrides that say how to sweep, not what a member is."""


class Sweep(Callback):
    """What Hydra calls around a sweep."""

    def on_multirun_start(self, config: DictConfig, **about: Any) -> None:
        """List all members before the first begins; a search chooses them as it goes."""
        if config.hydra.sweeper._target_.endswith(f".{BasicSweeper.__name__}"):
            with user_errors_reported():
                plan(config.hydra, str(about["config_name"]))

    def on_multirun_end(self, config: DictConfig, **about: Any) -> None:
        """Tell how the members ended; the exit code is 1 if one failed."""
        folder = Path(config.hydra.sweep.dir)
        every = sweep_jobs.read(folder)
        done = sum(job.state == "done" for job in every)
        print(
            f"Sweep {folder}: {done} of {len(every)} members done ({folder / sweep_jobs.FILE})",
            file=sys.stderr,
        )
        failed = [job for job in every if job.state == "failed"]
        for job in failed:
            print(f"  {job.folder} failed ({job.overrides}): {job.problem}", file=sys.stderr)
        if done < len(every):
            again = [_lasting(text) for text in sys.argv[1:] if not text.startswith("sweep_dir=")]
            command = shlex.join(["python", "-m", f"imagination.{config.hydra.job.name}", *again])
            print(f"Run what is not done: {command} sweep_dir={folder}", file=sys.stderr)
        if failed:
            sys.exit(1)


def _lasting(text: str) -> str:
    """The same argument tomorrow, when `latest` is another run."""
    path = Path(text.removeprefix("ckpt="))
    return f"ckpt={within(path)}" if text.startswith("ckpt=") and path.is_file() else text


def plan(hydra: DictConfig, config_name: str) -> None:
    """Enrol every member of a sweep over lists of values.

    Raises:
        UserError: if two members would train the same unit, and only evaluate it in another way.
    """
    given = [
        *(f"{key}={value}" for key, value in (hydra.sweeper.params or {}).items()),
        *hydra.overrides.task,
    ]
    parsed = OverridesParser.create(GlobalHydra.instance().config_loader()).parse_overrides(given)
    trained: dict[str, str] = {}
    enrolments = []
    for overrides in BasicSweeper.split_arguments(parsed, None)[0]:
        config, told = compose(config_name, list(overrides)), job_overrides(overrides)
        key = sweep_jobs.key_of(config)
        same = trained.setdefault(sweep_jobs.key_of(config, sweep_jobs.EVALUATION_ONLY), key)
        if config_name == "train" and same != key:
            raise UserError(
                f"sweep: {shlex.join(told)} differs from another member only in what evaluation reads; "
                "train once, then sweep that with python -m imagination.evaluate -m ckpt=…"
            )
        enrolments.append((key, told))
    for key, told in enrolments:
        sweep_jobs.register(Path(hydra.sweep.dir), key, told)


def job_overrides(overrides: list[str]) -> list[str]:
    """The overrides that say what a member is."""
    return [text for text in overrides if key(text) not in STEERING]


def run_job(task: Callable[[DictConfig], float | None], config: DictConfig) -> float | None:
    """Run one member in its folder, `paths.run`; what goes wrong is told and recorded, and the sweep goes on."""
    activate()  # a launcher may have started this process
    hydra = HydraConfig.get()
    sweep, key = Path(hydra.sweep.dir), sweep_jobs.key_of(config)
    about = sweep, key, job_overrides(list(hydra.overrides.task))
    job = sweep_jobs.register(*about)
    try:
        with locked(sweep, sweep_jobs.lock_name(job)):
            job = sweep_jobs.register(*about)  # what another process may have done meanwhile
            if job.state == "done":
                return float(job.score) if job.score else None
            print(f"Member {job.folder}: {job.overrides}", file=sys.stderr)
            sweep_jobs.update(sweep, key, state="running", problem="")
            shares.restart()
            config.paths.run = str(sweep / job.folder)
            validate(config)
            score = task(config)
            sweep_jobs.update(sweep, key, state="done", score="" if score is None else repr(score))
            return score
    except BusyError as error:
        print(f"Member {job.folder} is left out: {error}", file=sys.stderr)
    except (KeyboardInterrupt, SystemExit):
        sweep_jobs.update(sweep, key, state="stopped")
        print(
            f"The sweep was stopped; go on with the same command line and sweep_dir={sweep}", file=sys.stderr
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
