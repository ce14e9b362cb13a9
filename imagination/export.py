"""Export trained units for robots: `python -m imagination.export ckpt=…/best.ckpt format=onnx`."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from imagination.deployment.formats import PRECISIONS, SUFFIXES
from imagination.runs.command import command
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import UserError, check_choice, check_range

if TYPE_CHECKING:
    from imagination.deployment.export import Check
    from imagination.runs.checkpoint import Checkpoint

log = logging.getLogger(__name__)

CALIBRATION_VIEWS = 64
"""Number of views of training scenes for the calibration of int8."""


def validate(config: DictConfig) -> None:
    """Check the values of the config before any file is read.

    Raises:
        UserError: on the first value that is missing or out of range.
    """
    if OmegaConf.is_missing(config, "ckpt"):
        raise UserError("ckpt: got none, expected ckpt=outputs/<experiment>/latest/checkpoints/best.ckpt")
    if not isinstance(config.ckpt, str) and not config.ckpt:
        raise UserError("ckpt: got an empty list, expected a checkpoint or several of different categories")
    check_choice("format", config.format, PRECISIONS)
    check_choice(f"precision with format={config.format}", config.precision, PRECISIONS[config.format])
    if check_range("views", config.views, 1, 10_000, "views") != int(config.views):
        raise UserError(f"views: got {config.views}, expected a whole number")


@command("export", validate)
def main(config: DictConfig) -> None:
    """Export the units, and keep the file only if its predictions agree with those of PyTorch."""
    from imagination.deployment import export
    from imagination.deployment.load import load
    from imagination.deployment.torch_backend import CheckpointModule
    from imagination.mapping.predictor import UnitEnsemble
    from imagination.runs.checkpoint import Checkpoint  # imports torch, which --help does not need

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    paths = [config.ckpt] if isinstance(config.ckpt, str) else list(config.ckpt)
    checkpoints = [Checkpoint.read(path) for path in paths]
    file = Path(config.file) if config.file else Path(paths[0]).with_suffix(SUFFIXES[config.format])
    if file.suffix != SUFFIXES[config.format]:
        raise UserError(f"file: got {file}, expected a file name with the suffix {SUFFIXES[config.format]}")
    reference = UnitEnsemble([CheckpointModule(Path(path)) for path in paths])
    run = views_config(config, checkpoints)
    samples = export.sample_views(run, "val", config.views)
    calibration = (
        export.sample_views(run, "train", CALIBRATION_VIEWS) if config.precision == "int8" else samples
    )
    with replacing(file) as temporary:  # an existing file stays if the check fails
        export.export(checkpoints, temporary, config.format, config.precision, calibration)
        comparison = export.compare(load(temporary), reference, samples)
        check_accuracy(config, file, comparison, run.unit_categories)
    size = file.stat().st_size / 1e6
    log.info("%s, %.1f MB, on %d views: %s", file, size, len(samples), describe(comparison))


def views_config(config: DictConfig, checkpoints: Sequence[Checkpoint]) -> DictConfig:
    """Return the config of the views: that of the checkpoints' runs, with the paths and the cache of this command."""
    from imagination.evaluation.checkpoint_config import evaluation_config

    run = evaluation_config(checkpoints, [])
    run.paths, run.cache = config.paths, config.cache
    return run


def check_accuracy(config: DictConfig, file: Path, comparison: Check, categories: Sequence[str]) -> None:
    """Check that the predictions of an exported file agree with those of PyTorch.

    Args:
        config: config of the command.
        file: path of the exported file, for messages.
        comparison: comparison of the file with PyTorch.
        categories: categories of the units.

    Raises:
        UserError: if the predictions differ too much, or the labels lack a category.
    """
    from imagination.deployment.export import MAX_IOU_LOSS, TOLERANCE

    unseen = set(categories) - comparison.iou.keys()
    if config.precision != "float32" and unseen:
        raise UserError(
            f"views: got {config.views}, but their labels hold no {', '.join(sorted(unseen))}; use more views"
        )
    if config.precision == "float32":
        accurate, limit = comparison.difference <= TOLERANCE, f"a difference of at most {TOLERANCE}"
    else:
        accurate = comparison.loss <= MAX_IOU_LOSS
        limit = f"a loss of IoU of at most {MAX_IOU_LOSS} in each category"
    if not accurate:
        raise UserError(
            f"{file}: got {describe(comparison)}, expected {limit}; nothing was written, use another precision"
        )


def describe(comparison: Check) -> str:
    """Format the result of a comparison."""
    return f"largest difference {comparison.difference:.2g}, IoU {comparison.summary()}"


if __name__ == "__main__":
    main()
