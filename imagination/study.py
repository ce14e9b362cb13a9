"""The paper's whole study in one command: `python -m imagination.study scale=small`.

Trains what the study compares, one run after the other, then evaluates them together. Arguments are overrides, as of
imagination.train. Started again with the same arguments it goes on where it was: finished runs are left alone, an
unfinished one is resumed, and the evaluation takes up the scenes that are done. Runs of other commands count as well,
if they were trained with the same resolved config.
"""

import json
import logging
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from imagination.config.overrides import top
from imagination.config.validation import validate
from imagination.evaluation.checkpoint_config import evaluation_config
from imagination.runs.command import command
from imagination.runs.finished_trainings import evaluated, newest, planned
from imagination.runs.folder import BEST, LAST, create_folder, now
from imagination.runs.logging import logging_to
from imagination.utils.errors import UserError
from imagination.utils.timing import shares, stage

log = logging.getLogger(__name__)

OWN = ("experiments", "compare")
"""Keys of this command alone."""


@command("study", validate)
def main(config: DictConfig) -> None:
    """Train what is missing, then evaluate."""
    given = [text for text in HydraConfig.get().overrides.task if top(text) not in OWN]
    training = [text for text in given if not evaluated(text)]
    evaluation = [f"+study={config.compare}"]
    evaluation += [text for text in given if evaluated(text) or top(text) == "paths"]
    check(config.experiments, training, evaluation)
    outputs = Path(config.paths.outputs)
    with logging_to(create_folder(outputs / "study", now()) / "run.log"):
        checkpoints = []
        for experiment in config.experiments:
            with stage(experiment):
                checkpoints.append(str(trained(experiment, training, outputs)))
        with stage("evaluation"):
            _run("evaluate", [f"ckpt={json.dumps(checkpoints)}"], evaluation)
        parts = ", ".join(f"{name} {seconds / 60:.1f}" for name, seconds in shares.report().items())
        log.info("Minutes: %s", parts)


def check(experiments: Sequence[str], training: Sequence[str], evaluation: Sequence[str]) -> None:
    """Find mistakes in what is evaluated at the end before hours of training.

    Raises:
        UserError: if the networks do not go together or a setting of the evaluation is out of range.
    """
    from imagination.evaluation.approaches import NEEDS
    from imagination.runs.checkpoint import KEY, Checkpoint, ConfigInCheckpoint  # with it comes torch

    if not experiments:
        raise UserError("experiments: got none, expected such as [chair_unet,segmentation_hrnet]")
    networks = []
    for experiment in experiments:
        config = planned(experiment, training)
        validate(config)
        networks.append(Checkpoint(Path(experiment), {KEY: ConfigInCheckpoint(config).description}))
    asked = evaluation_config(networks, [f"ckpt={json.dumps(list(experiments))}", *evaluation])
    instantiate(asked.evaluation).available(NEEDS)


def trained(experiment: str, overrides: Sequence[str], outputs: Path) -> Path:
    """The best checkpoint of a finished run of an experiment with these overrides; trains or resumes where needed."""
    config = planned(experiment, overrides)
    if (folder := newest(outputs, config, finished=True)) is not None:
        log.info("%s: already trained, %s", experiment, folder)
    elif (folder := newest(outputs, config, finished=False)) is not None:
        _run(
            "train",
            [f"ckpt_path={folder / LAST}"],
            [text for text in overrides if top(text) == "paths"],
        )
    else:
        _run("train", [f"+experiment={experiment}", *overrides])
        folder = newest(outputs, config, finished=True)
    assert folder is not None, "a training that ended well has left its tables"
    return folder / (BEST if (folder / BEST).is_file() else LAST)


def _run(name: str, *overrides: Sequence[str]) -> None:
    """Run another command, whose messages go to the same screen; end with its code if it fails."""
    arguments = [text for texts in overrides for text in texts]
    log.info("python -m imagination.%s %s", name, shlex.join(arguments))
    code = subprocess.run([sys.executable, "-m", f"imagination.{name}", *arguments], check=False).returncode
    if code:
        log.error("imagination.%s ended with %d; the same command goes on where it was", name, code)
        sys.exit(code)


if __name__ == "__main__":
    main()
