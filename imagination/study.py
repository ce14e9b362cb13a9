"""The paper's whole study in one command: `python -m imagination.study scale=desk`.

Trains what the study compares, one run after the other, then evaluates them together. Arguments are overrides, as of
imagination.train. Started again with the same arguments it goes on where it was: finished runs are left alone, an
unfinished one is resumed, and the evaluation takes up the homes that are done. Runs of other commands count as well.
"""

import logging
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from imagination import runs
from imagination.config import command
from imagination.progress import shares, stage
from imagination.resume import choices, top

log = logging.getLogger(__name__)

OWN = ("experiments", "compare")
"""Keys of this command alone."""

EVALUATED = ("evaluation", "mapping", "ade20k")
"""Nodes that only evaluation reads: what they are set to retrains nothing."""


@command("study")
def main(config: DictConfig) -> None:
    """Train what is missing, then evaluate."""
    given = [text for text in HydraConfig.get().overrides.task if top(text) not in OWN]
    training = [text for text in given if top(text) not in EVALUATED]
    outputs = Path(config.paths.outputs)
    with runs.logging_to(runs.create_folder(outputs / "study", runs.now()) / "run.log"):
        checkpoints = []
        for experiment in config.experiments:
            with stage(experiment):
                checkpoints.append(trained(experiment, training, outputs))
        with stage("evaluation"):
            _run(
                "evaluate",
                [f"ckpt=[{','.join(map(str, checkpoints))}]", f"+study={config.compare}"],
                [text for text in given if top(text) in (*EVALUATED, "paths")],
            )
        parts = ", ".join(f"{name} {seconds / 60:.1f}" for name, seconds in shares.report().items())
        log.info("Minutes: %s", parts)


def trained(experiment: str, overrides: Sequence[str], outputs: Path) -> Path:
    """The best checkpoint of a finished run of an experiment with these overrides; trains or resumes where needed."""
    asked = [f"+experiment={experiment}", *overrides]
    if (folder := newest(outputs, asked, finished=True)) is not None:
        log.info("%s: already trained, %s", experiment, folder)
    elif (folder := newest(outputs, asked, finished=False)) is not None:
        _run(
            "train",
            [f"ckpt_path={folder / runs.LAST}"],
            [text for text in overrides if top(text) == "paths"],
        )
    else:
        _run("train", asked)
        folder = newest(outputs, asked, finished=True)
    assert folder is not None, "a training that ended well has left its tables"
    return folder / (runs.BEST if (folder / runs.BEST).is_file() else runs.LAST)


def newest(outputs: Path, overrides: Sequence[str], finished: bool) -> Path | None:
    """The newest run with these overrides, with its tables if it is to be finished, else with a checkpoint."""
    wanted = sorted(choices(overrides))
    needed = Path("tables") / "mapping.csv" if finished else runs.LAST
    found = [
        path.parent
        for path in outputs.glob(f"*/*/{runs.COMPOSED}")
        if (path.parent / needed).is_file() and not path.parent.is_symlink() and _choices_of(path) == wanted
    ]
    return max(found, key=lambda folder: folder.name, default=None)


def _choices_of(path: Path) -> list[str]:
    """The overrides that a run was started with."""
    return sorted(OmegaConf.select(OmegaConf.load(path), "choices", default=[]))


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
