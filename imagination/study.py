"""Run the whole study of the paper: `python -m imagination.study scale=small`.

Trains the networks of the study one after the other, then evaluates them together. Arguments are overrides, as for
imagination.train. `seeds=[0,1,2]` does so for each training seed: the results of a seed are in seed_<n>/, and the
tables of the study hold means and standard deviations over seeds. The same command can be repeated: finished runs are
reused, an unfinished run is resumed, and the evaluation reads finished trials from the cache. Runs of other commands
with the same resolved config are reused too.
"""

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf

from imagination.config.key_roles import KEYS, Role, role
from imagination.config.overrides import assignment, override_group, override_key
from imagination.config.validation import validate
from imagination.evaluation.checkpoint_config import evaluation_config
from imagination.models.task_kind import TaskKind
from imagination.runs.command import command, run_command
from imagination.runs.command_line import command_line, own_arguments
from imagination.runs.final_record import FINAL, write_final_record
from imagination.runs.finished_trainings import is_evaluation_only, train_or_reuse, training_config
from imagination.runs.folder import CONFIG
from imagination.runs.hydra_folder import new_run_folder
from imagination.runs.logging import logging_to
from imagination.utils import interrupts
from imagination.utils.atomic_io import write_text
from imagination.utils.errors import UserError
from imagination.utils.timing import stage, stage_timer

log = logging.getLogger(__name__)


@command("study", validate)
def main(config: DictConfig) -> None:
    """Train the missing networks, then evaluate all networks together."""
    overrides = [
        text for text in HydraConfig.get().overrides.task if role(override_key(text)) != Role.COMMAND
    ]
    for text in overrides:
        if override_key(text) in ("experiment", "name", "debug", "train", "test"):
            raise UserError(
                f"{override_key(text)}: got {text!r}, but a study trains and tests several experiments; choose them "
                "with experiments=[…]"
            )
    training = [text for text in overrides if not is_evaluation_only(text)]
    evaluation = [f"study={config.compare}"]
    evaluation += [
        text for text in overrides if is_evaluation_only(text) or override_group(text) in ("paths", "cache")
    ]
    seeds = check_seeds(config.seeds, training)
    check_evaluation(config.experiments, training, evaluation)
    folder = new_run_folder(config, continues=True)
    with logging_to(folder / "run.log"):
        try:
            for seed in seeds:
                evaluate_seed(config, seed, training, evaluation, folder)
            if config.seeds is not None:
                combine(folder, seeds)
        except KeyboardInterrupt:
            interrupts.report(f"Continue with: {command_line('study', own_arguments())}")
            sys.exit(interrupts.exit_code())
        times = ", ".join(f"{name} {seconds / 60:.1f}" for name, seconds in stage_timer.report().items())
        log.info("Minutes: %s", times)


def check_seeds(seeds: Any, overrides: Sequence[str]) -> Sequence[int | None]:
    """Return the training seeds; None for the seed of the overrides.

    Raises:
        UserError: if `seeds` is not a list of different seeds, or `seed` is set as well.
    """
    if seeds is None:
        return [None]
    low, high = KEYS["seed"].low or 0, KEYS["seed"].high or 0
    given = list(seeds) if isinstance(seeds, ListConfig) else []
    valid = [seed for seed in given if type(seed) is int and low <= seed <= high]
    if not given or len(set(valid)) < len(given):
        raise UserError(
            f"seeds: got {seeds}, expected different whole numbers from {low} to {high}, such as [0,1,2]"
        )
    if single := [text for text in overrides if override_key(text) == "seed"]:
        raise UserError(f"seed: got {single[0]} and seeds={given}, expected one of them; leave one out")
    return valid


def evaluate_seed(
    config: DictConfig, seed: int | None, training: Sequence[str], evaluation: Sequence[str], folder: Path
) -> None:
    """Train the missing networks of one training seed, then evaluate all networks together.

    Args:
        config: config of the study.
        seed: training seed, whose results are written into seed_<n>/; None for that of the overrides.
        training: overrides of the trainings.
        evaluation: overrides of the evaluation.
        folder: folder of the study.
    """
    name = "" if seed is None else f"seed_{seed}"
    if seed is not None:
        training = [*training, f"seed={seed}"]
    checkpoints = []
    for experiment in config.experiments:
        with stage(f"{experiment} {name}".strip()):
            checkpoints.append(str(train_or_reuse(experiment, training, Path(config.paths.outputs))))
    if seed is not None:  # evaluated again after an interruption; finished trials are in the cache
        (folder / name / FINAL).unlink(missing_ok=True)
    with stage(f"evaluation {name}".strip()):
        place = assignment("hydra.run.dir", str(folder / name))
        run_command("evaluate", [f"ckpt={json.dumps(checkpoints)}", *evaluation, place])


def combine(folder: Path, seeds: Sequence[int | None]) -> None:
    """Write the tables and figures of all training seeds into the folder of the study."""
    from imagination.reporting.results_folder import write_results  # imports matplotlib

    config = OmegaConf.load(folder / f"seed_{seeds[0]}" / CONFIG)
    write_text(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.merge(config, {"seeds": list(seeds)})))
    write_results(folder)
    write_final_record(folder, seeds=list(seeds))
    log.info("Results: %s/ (tables/, figures/, seed_*/)", folder)


def check_evaluation(experiments: Sequence[str], training: Sequence[str], evaluation: Sequence[str]) -> None:
    """Check the settings of the final evaluation before the trainings.

    Args:
        experiments: names of the experiments.
        training: overrides of the trainings.
        evaluation: overrides of the evaluation.

    Raises:
        UserError: if the networks cannot be evaluated together, or a setting of the evaluation is out of range.
    """
    from imagination.evaluation.approaches import NEEDS
    from imagination.runs.checkpoint import KEY, Checkpoint, hyperparameters  # imports torch

    if not experiments:
        raise UserError("experiments: got none, expected names such as [chair_unet,segmentation_hrnet]")
    configs = [training_config(experiment, training) for experiment in experiments]
    for config in configs:
        validate(config)
    check_epochs(configs)
    checkpoints = [
        Checkpoint(Path(experiment), {KEY: hyperparameters(config)})
        for experiment, config in zip(experiments, configs, strict=True)
    ]
    config = evaluation_config(checkpoints, [f"ckpt={json.dumps(list(experiments))}", *evaluation])
    instantiate(config.evaluation).available(NEEDS)


def check_epochs(configs: Sequence[DictConfig]) -> None:
    """Check that the baseline reuses the views of all epochs of the units.

    Raises:
        UserError: if the numbers of epochs differ.
    """
    epochs = {config.trainer.max_epochs for config in configs if config.model.predicts == TaskKind.MAPS}
    for config in configs:
        collected = config.callbacks.replay_buffer.collection_epochs
        if config.model.predicts == TaskKind.IMAGES and epochs - {collected}:
            raise UserError(
                f"trainer.max_epochs: got {max(epochs)} for the units, expected hrnet.collection_epochs, {collected}, "
                "whose views the baseline reuses; set the epochs in an experiment of the units, and hrnet.* to match"
            )


if __name__ == "__main__":
    main()
