"""Run the whole study of the paper: `python -m imagination.study scale=small`.

Trains the networks of the study one after the other, then evaluates them together. Arguments are overrides, as for
imagination.train. The same command can be repeated: finished runs are reused, an unfinished run is resumed, and the
evaluation reads finished trials from the cache. Runs of other commands with the same resolved config are reused too.
"""

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from imagination.config.key_roles import Role, role
from imagination.config.overrides import assignment, override_group, override_key
from imagination.config.validation import validate
from imagination.evaluation.checkpoint_config import evaluation_config
from imagination.models.task_kind import TaskKind
from imagination.runs.command import command, run_command
from imagination.runs.command_line import command_line, own_arguments
from imagination.runs.finished_trainings import is_evaluation_only, train_or_reuse, training_config
from imagination.runs.hydra_folder import new_run_folder
from imagination.runs.logging import logging_to
from imagination.utils import interrupts
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
    check_evaluation(config.experiments, training, evaluation)
    outputs = Path(config.paths.outputs)
    folder = new_run_folder(config, continues=True)
    evaluation.append(assignment("hydra.run.dir", str(folder)))
    with logging_to(folder / "run.log"):
        try:
            checkpoints = []
            for experiment in config.experiments:
                with stage(experiment):
                    checkpoints.append(str(train_or_reuse(experiment, training, outputs)))
            with stage("evaluation"):
                run_command("evaluate", [f"ckpt={json.dumps(checkpoints)}", *evaluation])
        except KeyboardInterrupt:
            interrupts.report(f"Continue with: {command_line('study', own_arguments())}")
            sys.exit(interrupts.exit_code())
        times = ", ".join(f"{name} {seconds / 60:.1f}" for name, seconds in stage_timer.report().items())
        log.info("Minutes: %s", times)


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
