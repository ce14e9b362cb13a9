"""Evaluate checkpoints: `python -m imagination.evaluate ckpt=outputs/chair_unet/latest/checkpoints/best.ckpt`.

The config is that of the (first) checkpoint's run, changed by the command line; nothing is trained.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
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

NOT_INHERITED = ("paths", "cache", "callbacks", "trainer", "logger", "choices", "ckpt_path", "resume")
"""Nodes of a run's config that say where and how it ran, not what was trained."""


@command("evaluate")
def main(config: DictConfig) -> None:
    """Evaluate the checkpoints that `ckpt` names."""
    if OmegaConf.is_missing(config, "ckpt"):
        raise UserError(
            "ckpt: got none, expected a checkpoint: ckpt=outputs/<experiment>/latest/checkpoints/best.ckpt"
        )
    from imagination.checkpoints import Checkpoint  # with it comes torch, which --help does without

    paths = [config.ckpt] if isinstance(config.ckpt, str) else list(config.ckpt)
    checkpoints = [Checkpoint.read(path) for path in paths]
    config = configured(checkpoints, list(HydraConfig.get().overrides.task))
    protocol = instantiate(config.evaluation)  # refuses what is out of range before anything is written
    folder = new_folder(config)
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
    held = [list(checkpoint.config.unit_categories) for checkpoint in checkpoints]
    every = [name for names in held for name in names]
    if len(set(every)) < len(every):
        raise UserError(f"ckpt: got checkpoints of {', '.join(every)}, expected each category once")
    categories = f"unit_categories={json.dumps(every)}"
    config = compose("evaluate", [*inherited(checkpoints[0]), categories, *overrides])
    validate(config)
    asked, start = list(config.unit_categories), 0
    for checkpoint, names in zip(checkpoints, held, strict=True):
        # with one checkpoint it must be of everything asked for, with several each of its part
        part = asked if len(checkpoints) == 1 else asked[start : start + len(names)]
        checkpoint.require(part, config.scale.resolution)
        start += len(names)
    return config


def inherited(checkpoint: Checkpoint) -> list[str]:
    """Overrides under which conf/evaluate.yaml composes to the config of the checkpoint's run, references kept.

    References are kept so that an override after these, such as `scale.viewpoint_sets=1`, reaches all that refer to it.
    """
    from imagination.checkpoints import KEY

    overrides = list(checkpoint.state[KEY]["choices"])
    wanted = dict(_leaves(OmegaConf.to_container(checkpoint.config)))
    for resolve in (
        False,
        True,
    ):  # first plain values, then values that the run had put in a reference's place
        composed = compose("evaluate", [*overrides, "paths.run=.", "ckpt=."])
        now = dict(_leaves(OmegaConf.to_container(composed, resolve=resolve)))
        references = tuple(key for key, value in now.items() if isinstance(value, str) and "${" in value)
        overrides += [
            f"++{key}={_quoted(value)}"
            for key, value in wanted.items()
            if key.partition(".")[0] not in NOT_INHERITED
            and (key not in now or now[key] != value)
            and not any(key == reference or key.startswith(reference + ".") for reference in references)
        ]
    return overrides


def new_folder(config: DictConfig) -> Path:
    """A folder for the results: outputs/<name>/evaluate_<date_time>, or a numbered one in that of the sweep."""
    hydra = HydraConfig.get()
    parent = Path(config.paths.outputs) / config.name
    if hydra.mode == RunMode.MULTIRUN:
        return runs.create_folder(parent / Path(hydra.sweep.dir).name, str(hydra.job.num))
    return runs.create_folder(parent, f"evaluate_{runs.now()}")


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of everything in a config that is not itself a mapping with entries."""
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from _leaves(value, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, node


def _quoted(value: Any) -> str:
    """A plain value as Hydra's command line writes it."""
    if isinstance(value, str):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
    if isinstance(value, list):
        return "[" + ",".join(map(_quoted, value)) + "]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_quoted(item)}" for key, item in value.items()) + "}"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)


if __name__ == "__main__":
    main()
