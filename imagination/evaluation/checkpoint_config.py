"""Config of the evaluation of checkpoints.

Example: `python -m imagination.evaluate ckpt=outputs/chair_unet/latest/checkpoints/best.ckpt`. The config is that of
the first checkpoint's run with the overrides of the command line.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from imagination.config.compose import compose
from imagination.config.overrides import override_group, override_key
from imagination.config.validation import validate
from imagination.models.task_kind import TaskKind
from imagination.utils.errors import UserError, first_of

if TYPE_CHECKING:
    from imagination.runs.checkpoint import Checkpoint
    from imagination.scenes.source import SceneSource

log = logging.getLogger(__name__)


def check_scenes(checkpoints: Sequence[Checkpoint], source: SceneSource) -> None:
    """Check that no validation or test scene is a training scene; warn if networks were trained in different scenes.

    Raises:
        UserError: if a validation or test scene is a training scene of a checkpoint.
    """
    for checkpoint in checkpoints:
        if not checkpoint.scenes:
            log.warning("ckpt: %s holds no training scenes, so the evaluation may use them", checkpoint.path)
    for split in ("val", "test"):
        evaluated = {source.identity(scene): scene for scene in source.scenes(split)}
        for checkpoint in checkpoints:
            if common := [identity for identity in checkpoint.scenes if identity in evaluated]:
                raise UserError(
                    f"ckpt: {checkpoint.path} was trained in {first_of(common)}, expected no scene of the split "
                    f"{split!r} (here {evaluated[common[0]]}); train again without them, or evaluate in other scenes"
                )
    recorded = [checkpoint for checkpoint in checkpoints if checkpoint.scenes]
    for other in recorded[1:]:
        if other.scenes != recorded[0].scenes:
            log.warning(
                "ckpt: %s and %s were trained in different scenes, or with different versions of the scene source",
                recorded[0].path,
                other.path,
            )


def evaluation_config(checkpoints: Sequence[Checkpoint], overrides: list[str]) -> DictConfig:
    """Compose the config of the evaluation from the first checkpoint, the categories of all and the overrides.

    Raises:
        UserError: if two checkpoints predict the same category, the categories, resolution or camera of a checkpoint
            differ from those of the others or of the overrides, or an override changes a network.
    """
    by_kind = {kind: [each for each in checkpoints if each.kind is kind] for kind in TaskKind}
    segmenters = by_kind[TaskKind.IMAGES]
    for group in by_kind.values():
        _refuse_duplicates(group)
    for other in checkpoints[1:]:
        other.check_compatible(checkpoints[0].config, f"checkpoint {checkpoints[0].path}")
    categories = [name for each in by_kind[TaskKind.MAPS] or segmenters for name in each.categories]
    overridden = {override_key(text) for text in overrides}
    inherited = [text for text in checkpoints[0].overrides if override_key(text) not in overridden]
    config = compose(
        "evaluate", [*inherited, f"unit_categories={json.dumps(categories)}", "paths.run=.", *overrides]
    )
    _refuse_other_networks(overrides)
    validate(config)
    for group in filter(None, by_kind.values()):
        _refuse_missing(group, config)
    for checkpoint in checkpoints:
        checkpoint.check_compatible(config)
    if segmenters and config.ade20k:
        raise UserError(
            f"ade20k: got {config.ade20k} and checkpoint {segmenters[0].path}, expected one segmentation "
            "network; leave one of them out"
        )
    return config


def _refuse_duplicates(checkpoints: Sequence[Checkpoint]) -> None:
    """Refuse checkpoints of one kind that predict the same category."""
    by_category: dict[str, Checkpoint] = {}
    for checkpoint in checkpoints:
        for name in checkpoint.categories:
            other = by_category.setdefault(name, checkpoint)
            if other is not checkpoint:
                raise UserError(
                    f"ckpt: got {other.path} and {checkpoint.path}, which both predict {name}, expected each category "
                    "once; leave one of them out"
                )


def _refuse_missing(checkpoints: Sequence[Checkpoint], config: DictConfig) -> None:
    """Refuse to evaluate a category that no checkpoint of a kind predicts."""
    missing = [
        name for name in config.unit_categories if not any(name in each.categories for each in checkpoints)
    ]
    if missing:
        available = "; ".join(
            f"checkpoint {each.path}: is of {', '.join(each.categories)} at {each.config.ego.resolution} m a cell"
            for each in checkpoints
        )
        raise UserError(
            f"{available}, but the evaluation asks for {', '.join(config.unit_categories)}; add a checkpoint of "
            f"{', '.join(missing)}, or leave out what overrides unit_categories"
        )


def _refuse_other_networks(overrides: Sequence[str]) -> None:
    """Refuse overrides of the networks, which are evaluated as they were trained."""
    for text in overrides:
        if override_group(text) in ("model", "hrnet", "experiment"):
            raise UserError(
                f"{override_key(text)}: got {text}, but networks are evaluated as they were trained; leave it out, or "
                "train a network with it"
            )
