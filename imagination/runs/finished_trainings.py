"""Find runs that were trained with a given configuration."""

import logging
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from imagination.config.compose import compose
from imagination.config.overrides import choices, key
from imagination.runs.folder import COMPOSED, LAST
from imagination.runs.resume import PROGRAM
from imagination.runs.sweep_jobs import EVALUATION_ONLY, key_of
from imagination.utils.cache import code_version

log = logging.getLogger(__name__)

EVALUATED = (*EVALUATION_ONLY, "ade20k")
"""Nodes that only evaluation reads: what they are set to retrains nothing."""

BESIDE = (*EVALUATION_ONLY, "choices", "ckpt_path", "resume")
"""Nodes of a run's config that do not decide what its training makes."""

SEGMENTATION = tuple(
    f"scale.hrnet{of}"
    for of in ("", "_accumulate", "_rounds", "_most_rounds", "_final_learning_rate", "_eval_every")
)
"""Nodes that only first-person segmentation reads."""


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


def trained_key(config: DictConfig) -> str:
    """Hash of what a run's training makes."""
    key = key_of(config, (*BESIDE, *(SEGMENTATION if config.model.predicts == "maps" else ())))
    return f"{key} {config.get('program')}"  # a run of other code is another run


def newest(outputs: Path, config: DictConfig, finished: bool) -> Path | None:
    """The newest run that trains what a config says and has a checkpoint; with its tables, if it is to be finished."""
    trained_by = trained_key(config)
    needed = (LAST, Path("tables") / "mapping.csv") if finished else (LAST,)
    found = [
        path.parent
        for path in outputs.glob(f"{config.name}/*/{COMPOSED}")
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
