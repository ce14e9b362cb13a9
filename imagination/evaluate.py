"""Evaluate checkpoints: `python -m imagination.evaluate ckpt=outputs/chair_unet/latest/checkpoints/best.ckpt`.

The config is that of the (first) checkpoint's run, changed by the command line; nothing is trained.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination import runs
from imagination.config import command, compose, validate
from imagination.errors import UserError

if TYPE_CHECKING:
    from imagination.checkpoints import Checkpoint
    from imagination.evaluation.prediction import Model
    from imagination.evaluation.protocol import MappingProtocol

log = logging.getLogger(__name__)


@command("evaluate")
def main(config: DictConfig) -> None:
    """Evaluate the checkpoints that `ckpt` names."""
    if OmegaConf.is_missing(config, "ckpt"):
        raise UserError(
            "ckpt: got none, expected a checkpoint: ckpt=outputs/<experiment>/latest/checkpoints/best.ckpt"
        )
    from imagination.checkpoints import Checkpoint  # with it comes torch, which --help does without

    member = None if OmegaConf.is_missing(config.paths, "run") else Path(config.paths.run)
    paths = [config.ckpt] if isinstance(config.ckpt, str) else list(config.ckpt)
    checkpoints = [Checkpoint.read(path) for path in paths]
    config = configured(checkpoints, list(HydraConfig.get().overrides.task))
    protocol = instantiate(config.evaluation)  # refuses what is out of range before anything is written
    folder = new_folder(config, member)
    config.paths.run = str(folder)
    with runs.logging_to(folder / "run.log"):
        runs.write_text(folder / runs.CONFIG, OmegaConf.to_yaml(config, resolve=True))
        try:
            evaluate(config, protocol, checkpoints, folder)
        except KeyboardInterrupt:
            log.warning(
                "Interrupted; %s holds no complete result. Views rendered so far stay in the cache.", folder
            )
            sys.exit(130)
        log.info("Results: %s/ (tables/, figures/)", folder)


def evaluate(
    config: DictConfig, protocol: MappingProtocol, checkpoints: Sequence[Checkpoint], folder: Path
) -> None:
    """Load the units, look at the homes, write tables and figures."""
    import torch

    from imagination.evaluation import results

    device = "cuda" if torch.cuda.is_available() else "cpu"
    models = [cast("Model", checkpoint.model().to(device)) for checkpoint in checkpoints]
    data = instantiate(config.data.module)
    try:
        results.evaluate(protocol, data, models, folder)
    finally:
        data.close()


def configured(checkpoints: Sequence[Checkpoint], overrides: list[str]) -> DictConfig:
    """The config of the evaluation: the first checkpoint's, with the categories of all, then the command line's.

    Raises:
        UserError: if a checkpoint is of other categories or another resolution than that asks for.
    """
    from imagination.checkpoints import KEY

    held = [list(checkpoint.config.unit_categories) for checkpoint in checkpoints]
    every = [name for names in held for name in names]
    if len(set(every)) < len(every):
        raise UserError(f"ckpt: got checkpoints of {', '.join(every)}, expected each category once")
    categories = f"unit_categories={json.dumps(every)}"
    given = {_key(text) for text in overrides}
    inherited = [text for text in checkpoints[0].state[KEY]["choices"] if _key(text) not in given]
    config = compose("evaluate", [*inherited, categories, "paths.run=.", *overrides])
    validate(config)
    asked, start = list(config.unit_categories), 0
    for checkpoint, names in zip(checkpoints, held, strict=True):
        # with one checkpoint it must be of everything asked for, with several each of its part
        part = asked if len(checkpoints) == 1 else asked[start : start + len(names)]
        checkpoint.require(part, config)
        start += len(names)
    return config


def _key(override: str) -> str:
    """What an override sets: Hydra takes a group's option only once."""
    return override.lstrip("+~").partition("=")[0]


def new_folder(config: DictConfig, member: Path | None) -> Path:
    """A folder for the results: outputs/<name>/evaluate_<date_time>, or that of a sweep's member."""
    if member is None:
        return runs.create_folder(Path(config.paths.outputs) / config.name, f"evaluate_{runs.now()}")
    with runs.write_errors_told(member):
        member.mkdir(parents=True, exist_ok=True)
    runs.remove_parts(member)  # of an evaluation that was killed
    return member


if __name__ == "__main__":
    main()
