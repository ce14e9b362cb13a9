"""Decorator that turns a function of a config into a command, and a function that runs another command."""

import logging
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import wraps

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from imagination.config.overrides import normalized, sweeps
from imagination.config.plugin_registry import core_conf, discover
from imagination.config.renamed_keys import check_renamed
from imagination.config.search_path import register_plugins
from imagination.config.unknown_keys import check_added_keys, unknown_keys_reported
from imagination.config.user_messages import user_errors_reported
from imagination.config.validation import validate
from imagination.runs.command_line import command_line
from imagination.runs.distributed import stop_job_at_once
from imagination.runs.extras import apply_extras
from imagination.runs.hydra_folder import check_hydra_overrides
from imagination.runs.sweep import interruption_reported, run_job
from imagination.utils import interrupts
from imagination.utils.errors import UserError
from imagination.utils.process_group import global_rank

log = logging.getLogger(__name__)

SAVING_SECONDS = 25.0
"""Time in which a subprocess must save its results after a signal; schedulers such as SLURM wait for 30 s."""

Task = Callable[[DictConfig], float | None]
"""Function of a command; a hyperparameter search maximises the score that it returns."""

DESCRIBE = {"--help", "-h", "--hydra-help", "--shell-completion", "-sc"}
"""Options of Hydra that describe a command instead of running it; they import no code of plugins."""


def command(config_name: str, check: Task | None = None) -> Callable[[Task], Callable[[], None]]:
    """Turn a function of a config into a command that composes conf/<config_name>.yaml with command-line overrides.

    A user error ends the command with one message and exit code 2; any other error shows its traceback.

    Args:
        config_name: name of the command and of its config.
        check: check of the config before the task runs; `validate` if None. A command with its own check has no run
            folders, so it refuses sweeps (-m).
    """

    def decorate(task: Task) -> Callable[[], None]:
        @wraps(task)
        def checked(config: DictConfig) -> float | None:
            if "extras" in config:
                apply_extras(config)
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                return run_job(task, config)
            with user_errors_reported():
                check_added_keys(config_name, list(HydraConfig.get().overrides.task))
                (check or validate)(config)
                return task(config)
            raise AssertionError("unreachable: user errors end the program")

        def main() -> None:
            interrupts.install()
            if global_rank():
                stop_job_at_once()
            os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of ending the program
            for plugin in discover():
                if plugin.problem and "-sc" not in sys.argv:  # would disturb the line that is completed
                    print(
                        f"plugin {plugin.name} ({plugin.origin}) is left out: {plugin.problem}",
                        file=sys.stderr,
                    )
            register_plugins(launchers=check is None and not DESCRIBE & set(sys.argv[1:]))
            with user_errors_reported(), interruption_reported():
                sys.argv[1:] = normalized(sys.argv[1:])
                check_renamed(config_name, sys.argv[1:])
                check_hydra_overrides(config_name, sys.argv[1:])
                if check is not None and any(map(sweeps, sys.argv[1:])):
                    raise UserError(
                        f"-m: imagination.{config_name} has no sweeps; run the command once for each value"
                    )
                with unknown_keys_reported(config_name):
                    hydra.main(version_base="1.3", config_path=str(core_conf()), config_name=config_name)(
                        checked
                    )()

        return main

    return decorate


def run_command(name: str, arguments: Sequence[str]) -> None:
    """Run another command of the project as a subprocess; exit with its code if it fails.

    A signal that ends this command is passed on to the subprocess, and one that ends the subprocess ends this command.
    """
    log.info("%s", command_line(name, arguments))
    environment = os.environ | {interrupts.CALLER: str(os.getpid())}
    process = None
    try:
        with interrupts.postponed():
            process = subprocess.Popen(
                [sys.executable, "-m", f"imagination.{name}", *arguments], env=environment
            )
        code = process.wait()
    except KeyboardInterrupt:
        if process is not None:
            _end(process)
        raise
    for number in interrupts.SIGNALS:
        if code in (128 + number, -number):
            interrupts.interrupt(number)
    if code:
        log.error(
            "imagination.%s failed with exit code %d; run the same command again to continue", name, code
        )
        sys.exit(code)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Pass on the signal that ends this process, and wait until the subprocess has saved its results."""
    with interrupts.postponed():
        process.send_signal(interrupts.exit_code() - 128)
        try:
            process.wait(SAVING_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
