"""The paper's whole study in one command: `python -m imagination.study scale=desk`.

Trains what the study compares, one run after the other, then evaluates them together. Arguments are overrides, as of
imagination.train. Started again with the same arguments it goes on where it was: finished runs are left alone, an
unfinished one is resumed, and the evaluation takes up the homes that are done. Runs of other commands count as well,
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
from omegaconf import DictConfig, OmegaConf

from imagination import runs
from imagination.cache import code_version
from imagination.config import command, compose, validate
from imagination.errors import UserError
from imagination.evaluate import configured
from imagination.members import EVALUATION_ONLY, key_of
from imagination.progress import shares, stage
from imagination.resume import PROGRAM, choices, key, top

log = logging.getLogger(__name__)

OWN = ("experiments", "compare")
"""Keys of this command alone."""

EVALUATED = (*EVALUATION_ONLY, "ade20k")
"""Nodes that only evaluation reads: what they are set to retrains nothing."""

BESIDE = (*EVALUATION_ONLY, "choices", "ckpt_path", "resume")
"""Nodes of a run's config that do not decide what its training makes."""

SEGMENTATION = tuple(
    f"scale.hrnet{of}"
    for of in ("", "_accumulate", "_rounds", "_most_rounds", "_final_learning_rate", "_eval_every")
)
"""Nodes that only first-person segmentation reads."""


@command("study", validate)
def main(config: DictConfig) -> None:
    """Train what is missing, then evaluate."""
    given = [text for text in HydraConfig.get().overrides.task if top(text) not in OWN]
    training = [text for text in given if not evaluated(text)]
    evaluation = [f"+study={config.compare}"]
    evaluation += [text for text in given if evaluated(text) or top(text) == "paths"]
    check(config.experiments, training, evaluation)
    outputs = Path(config.paths.outputs)
    with runs.logging_to(runs.create_folder(outputs / "study", runs.now()) / "run.log"):
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
    from imagination.checkpoints import KEY, Checkpoint, ConfigInCheckpoint  # with it comes torch
    from imagination.evaluation.approaches import NEEDS

    if not experiments:
        raise UserError("experiments: got none, expected such as [chair_unet,segmentation_hrnet]")
    networks = []
    for experiment in experiments:
        config = planned(experiment, training)
        validate(config)
        networks.append(Checkpoint(Path(experiment), {KEY: ConfigInCheckpoint(config).description}))
    asked = configured(networks, [f"ckpt={json.dumps(list(experiments))}", *evaluation])
    instantiate(asked.evaluation).available(NEEDS)


def evaluated(override: str) -> bool:
    """Whether only evaluation reads what an override sets."""
    changed = key(override)
    return any(changed == node or changed.startswith((f"{node}.", f"{node}/")) for node in EVALUATED)


def planned(experiment: str, overrides: Sequence[str]) -> DictConfig:
    """The config of an experiment's run, as imagination.train composes it."""
    asked = [f"+experiment={experiment}", *overrides]
    config = compose("train", [*asked, "paths.run=."])
    config.choices, config.program = choices(asked), code_version(PROGRAM)
    return config


def trained(experiment: str, overrides: Sequence[str], outputs: Path) -> Path:
    """The best checkpoint of a finished run of an experiment with these overrides; trains or resumes where needed."""
    config = planned(experiment, overrides)
    if (folder := newest(outputs, config, finished=True)) is not None:
        log.info("%s: already trained, %s", experiment, folder)
    elif (folder := newest(outputs, config, finished=False)) is not None:
        _run(
            "train",
            [f"ckpt_path={folder / runs.LAST}"],
            [text for text in overrides if top(text) == "paths"],
        )
    else:
        _run("train", [f"+experiment={experiment}", *overrides])
        folder = newest(outputs, config, finished=True)
    assert folder is not None, "a training that ended well has left its tables"
    return folder / (runs.BEST if (folder / runs.BEST).is_file() else runs.LAST)


def trained_key(config: DictConfig) -> str:
    """Hash of what a run's training makes."""
    key = key_of(config, (*BESIDE, *(SEGMENTATION if config.model.predicts == "maps" else ())))
    return f"{key} {config.get('program')}"  # a run of other code is another run


def newest(outputs: Path, config: DictConfig, finished: bool) -> Path | None:
    """The newest run that trains what a config says and has a checkpoint; with its tables, if it is to be finished."""
    trained_by = trained_key(config)
    needed = (runs.LAST, Path("tables") / "mapping.csv") if finished else (runs.LAST,)
    found = [
        path.parent
        for path in outputs.glob(f"{config.name}/*/{runs.COMPOSED}")
        if all((path.parent / name).is_file() for name in needed)
        and not path.parent.is_symlink()
        and _trains(path, trained_by)
    ]
    return max(found, key=lambda folder: folder.name, default=None)


def _trains(path: Path, trained_by: str) -> bool:
    """Whether the config of a run has this hash, and nothing that only evaluation reads, which it would pass on."""
    try:
        config = OmegaConf.load(path)
        assert isinstance(config, DictConfig)
        return trained_key(config) == trained_by and not any(map(evaluated, config.choices))
    except Exception as error:  # yaml raises anything on what looks like a date or a number
        log.warning("study: %s is damaged (%s); its run is not taken", path, error)
        return False


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
