"""Evaluate checkpoints: `python -m imagination.evaluate ckpt=outputs/chair_unet/latest/checkpoints/best.ckpt`.

The config is that of the (first) checkpoint's run, changed by the command line; nothing is trained.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from imagination.config.compose import compose
from imagination.config.overrides import key, top
from imagination.config.validation import validate
from imagination.utils.errors import UserError

if TYPE_CHECKING:
    from imagination.runs.checkpoint import Checkpoint
    from imagination.scenes.source import SceneSource

log = logging.getLogger(__name__)


def check_scenes(checkpoints: Sequence[Checkpoint], source: SceneSource) -> None:
    """Check that no scene that is chosen or measured on was trained in; tell if networks were trained in different ones.

    Raises:
        UserError: with a scene that was.
    """
    for split in ("val", "test"):
        here = {source.fingerprint(scene): scene for scene in source.scenes(split)}
        for checkpoint in checkpoints:
            if both := [(name, here[found]) for name, found in checkpoint.scenes.items() if found in here]:
                trained, found = both[0]
                raise UserError(
                    f"ckpt: {checkpoint.path} was trained in {trained}, which is {found} of the split {split!r} now; "
                    "train it again with these scenes, or evaluate with those it was trained with"
                )
    told = [checkpoint for checkpoint in checkpoints if checkpoint.scenes]
    for other in told[1:]:
        if set(other.scenes.values()) != set(told[0].scenes.values()):
            log.warning(
                "ckpt: %s and %s were trained in different scenes, or by different versions of what makes scenes",
                told[0].path,
                other.path,
            )


def evaluation_config(checkpoints: Sequence[Checkpoint], overrides: list[str]) -> DictConfig:
    """The config of the evaluation: the first checkpoint's, with the categories of all, then the command line's.

    Raises:
        UserError: if two checkpoints give the same category, or one is of other categories, another resolution or
            another camera than the others or the command line ask for, or the command line changes networks.
    """
    from imagination.runs.checkpoint import KEY

    by_kind = {kind: [one for one in checkpoints if one.predicts == kind] for kind in ("maps", "images")}
    for of_kind in by_kind.values():
        _refuse_twice(of_kind)
    for other in checkpoints[1:]:
        other.require(checkpoints[0].config, f"checkpoint {checkpoints[0].path}")
    every = [name for one in by_kind["maps"] or by_kind["images"] for name in one.categories]
    given = {key(text) for text in overrides}
    inherited = [text for text in checkpoints[0].state[KEY]["choices"] if key(text) not in given]
    config = compose(
        "evaluate", [*inherited, f"unit_categories={json.dumps(every)}", "paths.run=.", *overrides]
    )
    config.sweep_dir = None  # Hydra has it; with its date it is no part of what is evaluated
    _refuse_other_networks(config, overrides)
    validate(config)
    for of_kind in filter(None, by_kind.values()):
        _refuse_missing(of_kind, config)
    for checkpoint in checkpoints:
        checkpoint.require(config)
    if by_kind["images"] and config.ade20k:
        raise UserError(
            f"ade20k: got {config.ade20k} beside checkpoint {by_kind['images'][0].path}, expected one segmentation "
            "network; leave one of them out"
        )
    return config


def _refuse_twice(checkpoints: Sequence[Checkpoint]) -> None:
    """Refuse checkpoints of one kind that give the same category."""
    givers: dict[str, Checkpoint] = {}
    for checkpoint in checkpoints:
        for name in checkpoint.categories:
            other = givers.setdefault(name, checkpoint)
            if other is not checkpoint:
                raise UserError(
                    f"ckpt: got {other.path} and {checkpoint.path}, which both give {name}, expected each category "
                    "once; leave one of them out"
                )


def _refuse_missing(checkpoints: Sequence[Checkpoint], config: DictConfig) -> None:
    """Refuse to evaluate a category that no checkpoint of a kind gives."""
    missing = [
        name for name in config.unit_categories if not any(name in one.categories for one in checkpoints)
    ]
    if missing:
        held = "; ".join(
            f"checkpoint {one.path}: is of {', '.join(one.categories)} at {one.config.ego.resolution} m a cell"
            for one in checkpoints
        )
        raise UserError(
            f"{held}, but the evaluation asks for {', '.join(config.unit_categories)}; add a checkpoint of "
            f"{', '.join(missing)}, or leave out what overrides unit_categories"
        )


def _refuse_other_networks(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse overrides of what networks are: they stay as they were trained, so nothing would follow from them."""
    described = OmegaConf.to_yaml(config.model)  # with its references to the scale
    for text in overrides:
        if top(text) == "model" or (top(text) == "scale" and f"${{{key(text)}}}" in described):
            raise UserError(
                f"{key(text)}: got {text}, but networks are evaluated as they were trained; leave it "
                "out, or train one with it"
            )
