"""Commands with a composed config: where conf lies, what it may hold, how mistakes are told."""

import inspect
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from typing import Any

import hydra
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from imagination import plugins
from imagination.errors import UserError, check_choice, check_range
from imagination.geometry.grid import cells_of
from imagination.precision import PRECISIONS
from imagination.runs import check_name

RANGES: Mapping[str, tuple[float, float, str]] = {
    "seed": (0, 2**32 - 1, ""),
    "aggregation_factor": (0.0, 1.0, ""),
    "kernels.imaginable": (0.005, 10.0, "m"),
    "kernels.neighbourhood": (0.005, 10.0, "m"),
    "kernels.truth": (0.005, 10.0, "m"),
    "robot.radius": (0.0, 2.0, "m"),
    "cache.max_gigabytes": (0.001, 1_000_000.0, "GB"),
    "scale.resolution": (0.005, 1.0, "m"),
    "scale.ego_extent": (0.5, 100.0, "m"),
    "scale.world_extent": (1.0, 10_000.0, "m"),
    "scale.image": (8, 8192, "pixels"),
    "scale.truth_image": (8, 8192, "pixels"),
    "scale.homes.train": (1, 9999, "homes"),
    "scale.homes.val": (1, 9999, "homes"),
    "scale.homes.test": (1, 9999, "homes"),
    "scale.held_out_views.val": (1, 10_000_000, "views"),
    "scale.held_out_views.test": (1, 10_000_000, "views"),
    "scale.parallel_scenes": (1, 4096, "scenes"),
    "scale.balanced_share": (0.0, 1.0, ""),
    "scale.update_interval": (1, 10_000, "collection steps"),
    "scale.update_batches": (1, 100_000, "batches"),
    "scale.buffer_size": (1, 10_000_000, "views"),
    "scale.prefill_steps": (0, 10_000_000, "collection steps"),
    "scale.eval_every": (1, 1_000_000, "rounds"),
    "scale.eval_homes": (1, 100_000, "homes"),
    "scale.batch_size": (1, 100_000, "views"),
    "scale.accumulate": (1, 100_000, "parts"),
    "scale.hrnet_accumulate": (1, 100_000, "parts"),
    "scale.rounds": (1, 10**9, "rounds"),
    "scale.learning_rate": (0.0, 10.0, ""),
    "scale.final_learning_rate": (0.0, 10.0, ""),
    "scale.hrnet_final_learning_rate": (0.0, 10.0, ""),
    "scale.unit_width": (1, 1024, "channels"),
    "scale.height_jitter": (0.0, 0.5, ""),
    "scale.dilated_answers": (0.0, 2.0, "m"),
    "scale.mirrored_share": (0.0, 1.0, ""),
    "scale.encoder_shrink": (1, 64, ""),
    "scale.viewpoint_sets": (1, 10_000, ""),
    "scale.orientations": (1, 1000, ""),
    "scale.hrnet_rounds": (1, 10**9, "rounds"),
    "scale.hrnet_most_rounds": (1, 10**9, "rounds"),
    "scale.hrnet_eval_every": (1, 1_000_000, "rounds"),
    "scale.workers": (0, 1024, "processes"),
    "trainer.max_epochs": (1, 10**9, "rounds"),
    "trainer.devices": (1, 1024, "devices"),
    "trainer.num_nodes": (1, 10_000, "hosts"),
}
"""What is checked before anything is built; builders check what they get as well. Whole bounds mean whole numbers."""

EXTRAS: Mapping[str, str] = {"hydra/launcher/joblib": "joblib", "hydra/sweeper/optuna": "optuna"}
"""Options that come with an extra of the project."""

CELL_WIDTH = (0.1, 100.0, "m")

TRUSTED = (
    "imagination",
    "lightning.pytorch.trainer",
    "lightning.pytorch.callbacks",
    "lightning.pytorch.loggers",
    "torch.nn",
    "torch.optim",
    "torchmetrics",
)
"""Where classes that a config read from a file builds may be defined, besides plugins."""

RESOLVER = re.compile(r"\$\{[\w.]+:")
"""A call inside a value, such as ${oc.decode:…}, which could make a target out of text."""

Task = Callable[[DictConfig], float | None]
"""What a command does; a figure that it returns is what a search maximises."""


def sweeps(word: str) -> bool:
    """Whether a word of a command line asks for several runs."""
    return word in ("-m", "--multirun") or word.lstrip("+").startswith(("sweep=", "hparams_search="))


class _SearchPath(SearchPathPlugin):
    """Lets Hydra find the conf trees of sound plugins, after the core's."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for plugin in plugins.activate():
            search_path.append(provider=f"plugin {plugin.name}", path=f"file://{plugin.conf}")


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
                from imagination.sweep import run_member  # which imports this module

                return run_member(task, config)
            with mistakes_told():
                (check or validate)(config)
                return task(config)
            raise AssertionError("unreachable: mistakes end the program")

        def main() -> None:
            os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then passes errors on instead of ending the program
            for plugin in plugins.discover():
                if plugin.problem:
                    print(f"{plugin.name} ({plugin.origin}) is left out: {plugin.problem}", file=sys.stderr)
            _register()
            with mistakes_told():
                if check is not None and any(map(sweeps, sys.argv[1:])):
                    raise UserError(
                        f"-m: imagination.{config_name} knows no sweeps; call it once for each value"
                    )
                hydra.main(version_base="1.3", config_path=str(plugins.core_conf()), config_name=config_name)(
                    checked
                )()

        return main

    return decorate


@contextmanager
def mistakes_told() -> Iterator[None]:
    """End the program with one message and exit code 2 on an error that is the user's to mend.

    Both around a task and around Hydra, which would announce the task's errors in its own way.
    """
    try:
        yield
    except KeyboardInterrupt:  # before a command has anything that could go on
        print("Interrupted", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if (message := explain(error)) is None:
            raise
        print(f"error: {message}", file=sys.stderr)
        sys.exit(2)


def compose(config_name: str, overrides: list[str]) -> DictConfig:
    """Compose a config as a command would, from a script or inside another command."""
    if GlobalHydra.instance().is_initialized():
        return hydra.compose(config_name, overrides)
    _register()
    with hydra.initialize_config_dir(str(plugins.core_conf()), version_base="1.3"):
        return hydra.compose(config_name, overrides)


def explain(error: BaseException) -> str | None:
    """What to tell the user about an error that is theirs to mend; None if it is the program's."""
    if not isinstance(error, (UserError, HydraException, OmegaConfBaseException)):
        return None
    causes = list(_causes(error))
    for cause in causes:
        if isinstance(cause, UserError):  # the builder of some part raised it, Hydra wrapped it
            return str(cause)
    if any(not isinstance(cause, (HydraException, OmegaConfBaseException, ImportError)) for cause in causes):
        return None
    texts = dict.fromkeys(str(cause).partition("\nConfig search path")[0].strip() for cause in causes)
    told = "\n".join(text for text in texts if not any(text in other for other in texts if other != text))
    missing = [extra for option, extra in EXTRAS.items() if f"'{option}'" in told]
    return "\n".join([told, *(f"Install it: pip install 'imagination[{extra}]'" for extra in missing)])


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


def _register() -> None:
    plugins.activate()  # before Hydra looks for launchers among what can be imported
    if _SearchPath not in Plugins.instance().discover(SearchPathPlugin):
        Plugins.instance().register(_SearchPath)
    # there is one store and it is only read, but --help would copy it for each of a hundred config groups
    setattr(ConfigStore, "__deepcopy__", lambda store, memo: store)  # noqa: B010  (mypy knows no such method)


def leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Values of a resolved config by dotted key; the class of what a node builds goes by the node's name."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        elif key == "_target_":
            yield prefix.removesuffix("."), str(value).rpartition(".")[2]
        elif not key.startswith("_"):
            yield f"{prefix}{key}", value


def validate(config: DictConfig) -> None:
    """Check what the user may have got wrong before hours are spent.

    Raises:
        UserError: on the first value out of range, with what is allowed.
    """
    check_name(config.name)
    for key, bounds in RANGES.items():
        if OmegaConf.select(config, key.partition(".")[0]) is not None:  # not every command has a trainer
            _check_number(key, OmegaConf.select(config, key), *bounds)
    for key in ("scale.precision", "trainer.precision", "evaluation.precision"):
        if OmegaConf.select(config, key.partition(".")[0]) is not None:
            check_choice(key, OmegaConf.select(config, key), PRECISIONS)
    if not isinstance(config.scale.mirrored_answers, bool):
        raise UserError(
            f"scale.mirrored_answers: got {config.scale.mirrored_answers!r}, expected true or false"
        )
    rounds = [config.scale[name] for name in ("rounds", "hrnet_rounds", "hrnet_most_rounds")]
    if OmegaConf.select(config, "model.predicts") == "images" and rounds != sorted(rounds):
        raise UserError(
            f"scale.hrnet_rounds: got {rounds[1]}, expected scale.rounds, {rounds[0]}, to scale.hrnet_most_rounds, "
            f"{rounds[2]}: a baseline trains as long as the units"
        )
    widths = config.scale.cell_widths
    if not isinstance(widths, ListConfig) or not widths:
        raise UserError(f"scale.cell_widths: got {widths!r}, expected a list of metres such as [3.0, 2.5]")
    for width in widths:
        _check_number("scale.cell_widths", width, *CELL_WIDTH)
    for extent in (config.scale.ego_extent, config.scale.world_extent):
        cells_of(extent, config.scale.resolution)
    if not config.unit_categories:
        raise UserError(
            "unit_categories: got none, expected at least one of: " + ", ".join(config.categories)
        )
    for name in config.unit_categories:
        check_choice("category", name, config.categories)
    if config.kernels.imaginable < config.kernels.neighbourhood:
        warnings.warn(
            f"kernels.imaginable ({config.kernels.imaginable} m) is smaller than kernels.neighbourhood "
            f"({config.kernels.neighbourhood} m): W_gamma then covers label cells that the imaginable mask removed",
            stacklevel=2,
        )


def check_targets(config: DictConfig) -> None:
    """Check that a config read from a file builds only classes of the program, its plugins and its libraries.

    Raises:
        UserError: if a `_target_` is something else or cannot be found, or a value calls a resolver.
    """
    if call := RESOLVER.search(OmegaConf.to_yaml(config)):
        raise UserError(
            f"config: got a value with {call[0]!r}, expected plain values and references; start a new run"
        )
    allowed = {*TRUSTED, *(package for plugin in plugins.activate() for package in plugin.packages)}
    tops = {prefix.partition(".")[0] for prefix in allowed}
    for target in dict.fromkeys(plugins.targets_of(OmegaConf.to_container(config))):
        try:
            made = hydra.utils.get_object(target) if target.partition(".")[0] in tops else None
        except (ImportError, AttributeError) as error:
            raise UserError(
                f"_target_: got {target!r}, which cannot be found; install its plugin again"
            ) from error
        # a class, or the class of a method that makes one; where it is defined counts, not the path that leads to it
        kind = made if inspect.isclass(made) else getattr(made, "__self__", None)
        home = kind.__module__ if inspect.isclass(kind) else ""
        if not any(home == prefix or home.startswith(f"{prefix}.") for prefix in allowed):
            raise UserError(
                f"_target_: got {target!r}, expected a class defined in {', '.join(sorted(allowed))}; "
                "if you trust it, start a new run with it"
            )


def _check_number(key: str, value: Any, low: float, high: float, unit: str) -> None:
    whole = isinstance(low, int)
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        kind = "whole number" if whole else "number"
        raise UserError(f"{key}: got {value!r}, expected a {kind} in [{low}, {high}] {unit}".rstrip())
    check_range(key, value, low, high, unit)
