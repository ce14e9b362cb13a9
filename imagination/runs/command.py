"""The decorator that makes a function of a configuration into a command."""

import os
import sys
from collections.abc import Callable
from functools import wraps

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from imagination.config.compose import register_plugins
from imagination.config.overrides import sweeps
from imagination.config.plugin_registry import core_conf, discover
from imagination.config.user_messages import user_errors_reported
from imagination.config.validation import validate
from imagination.runs.sweep import run_job
from imagination.utils.errors import UserError

Task = Callable[[DictConfig], float | None]
"""What a command does; a figure that it returns is what a search maximises."""


def command(config_name: str, check: Task | None = None) -> Callable[[Task], Callable[[], None]]:
    """Make a function of a config into a command that composes conf/<config_name>.yaml from the command line.

    `check` looks at the config before anything is built; `validate` if None. Commands with their own have no runs that
    a sweep could list, so they refuse -m.
    Mistakes of the user are told in one message with exit code 2; anything else shows its traceback.
    """

    def decorate(task: Task) -> Callable[[], None]:
        @wraps(task)
        def checked(config: DictConfig) -> float | None:
            config.sweep_dir = None  # Hydra has it from here on; with its date it is no part of a run
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                return run_job(task, config)
            with user_errors_reported():
                (check or validate)(config)
                return task(config)
            raise AssertionError("unreachable: mistakes end the program")

        def main() -> None:
            os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then passes errors on instead of ending the program
            for plugin in discover():
                if plugin.problem:
                    print(f"{plugin.name} ({plugin.origin}) is left out: {plugin.problem}", file=sys.stderr)
            register_plugins()
            with user_errors_reported():
                if check is not None and any(map(sweeps, sys.argv[1:])):
                    raise UserError(
                        f"-m: imagination.{config_name} knows no sweeps; call it once for each value"
                    )
                hydra.main(version_base="1.3", config_path=str(core_conf()), config_name=config_name)(
                    checked
                )()

        return main

    return decorate
