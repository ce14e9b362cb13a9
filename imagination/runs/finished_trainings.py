"""Search for runs with the same training, which are reused or resumed instead of a new training."""

import logging
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from imagination.config.compose import compose
from imagination.config.key_roles import Role, role
from imagination.config.overrides import assignment, override_group, override_key, result_overrides
from imagination.models.task_kind import TaskKind
from imagination.runs.command import run_command
from imagination.runs.composed_config import load_composed_config
from imagination.runs.final_record import read_final_record
from imagination.runs.folder import BEST, COMPOSED, LAST
from imagination.runs.program import program
from imagination.runs.sweep_jobs import config_key
from imagination.utils.errors import UserError

log = logging.getLogger(__name__)


def is_evaluation_only(override: str) -> bool:
    """Return whether only the evaluation reads the key of an override."""
    return role(override_key(override)) == Role.EVALUATION


def training_config(experiment: str, overrides: Sequence[str]) -> DictConfig:
    """Return the config of an experiment's run, as `imagination.train` composes it."""
    overrides = [f"experiment={experiment}", *overrides]
    config = compose("train", [*overrides, "paths.run=."])
    config.choices, config.program = result_overrides(overrides, config), program(config)
    return config


def training_key(config: DictConfig) -> str:
    """Return the hash of what determines the result of a training: keys of the role `TRAINING` and the program."""
    if config.model.predicts == TaskKind.MAPS:  # units do not read the node of segmentation_hrnet
        config = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hrnet"])
    return f"{config_key(config, set(Role) - {Role.TRAINING})} {config.get('program')}"


def newest_run(outputs: Path, config: DictConfig, finished: bool) -> Path | None:
    """Return the newest run folder with a checkpoint and the same training as `config`, or None.

    Args:
        outputs: folder of all experiments.
        config: config of the training.
        finished: whether only finished runs, which have a final record of all epochs, are considered.
    """
    key = training_key(config)

    def is_finished(folder: Path) -> bool:
        record = read_final_record(folder) or {}
        return bool(record.get("max_epochs") == config.trainer.max_epochs)

    folders = [
        path.parent
        for path in outputs.glob(f"{config.name}/*/{COMPOSED}")
        if (path.parent / LAST).is_file()
        and (not finished or is_finished(path.parent))
        and not path.parent.is_symlink()
        and _has_training_key(path, key)
    ]
    return max(folders, key=lambda folder: folder.name, default=None)


def train_or_reuse(experiment: str, overrides: Sequence[str], outputs: Path) -> Path:
    """Return the best checkpoint of an experiment from a finished run, or after training or resuming one."""
    config = training_config(experiment, overrides)
    if (folder := newest_run(outputs, config, finished=True)) is not None:
        log.info("%s: already trained, %s", experiment, folder)
    else:
        if (unfinished := newest_run(outputs, config, finished=False)) is not None:
            paths = [text for text in overrides if override_group(text) in ("paths", "cache")]
            run_command("train", [assignment("resume", str(unfinished)), *paths])
        else:
            run_command("train", [f"experiment={experiment}", *overrides])
        folder = newest_run(outputs, config, finished=True)
    if folder is None:
        raise UserError(
            f"{experiment}: the training ended without its final record in {outputs / config.name}; run the same "
            "command again"
        )
    return folder / (BEST if (folder / BEST).is_file() else LAST)


def _has_training_key(path: Path, key: str) -> bool:
    """Return whether a run's config has this training key and no overrides that only the evaluation reads.

    Such overrides would be inherited by the evaluation of the run's checkpoint.
    """
    try:
        config = load_composed_config(path)
        return training_key(config) == key and not any(map(is_evaluation_only, config.choices))
    except Exception as error:  # nodes may be missing or of another type
        log.warning("study: %s is damaged (%s); its run is ignored", path, error)
        return False
