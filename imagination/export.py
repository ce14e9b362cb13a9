"""Trained units as files for robots: `python -m imagination.export ckpt=…/best.ckpt format=onnx`."""

from __future__ import annotations

import logging
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from imagination.deployment.formats import PRECISIONS, SUFFIXES
from imagination.runs.command import command
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import UserError, check_choice, check_range

log = logging.getLogger(__name__)

CALIBRATION_VIEWS = 64
"""Of training scenes, that the ranges of int8 are taken from."""


def validate(config: DictConfig) -> None:
    """Check what the user may have got wrong before anything is read.

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
    check_range("tolerance", config.tolerance, 0.0, 1.0)
    check_range("max_loss", config.max_loss, 0.0, 1.0)
    if not isinstance(config.look_once, bool):
        raise UserError(f"look_once: got {config.look_once!r}, expected true or false")


@command("export", validate)
def main(config: DictConfig) -> None:
    """Write the file, ask it and PyTorch about the same views, and keep it if they agree."""
    from imagination.deployment import export
    from imagination.deployment.load import load
    from imagination.deployment.torch_backend import CheckpointModule
    from imagination.mapping.predictor import UnitEnsemble
    from imagination.runs.checkpoint import Checkpoint  # with it comes torch, which --help does without

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    paths = [config.ckpt] if isinstance(config.ckpt, str) else list(config.ckpt)
    checkpoints = [Checkpoint.read(path) for path in paths]
    file = Path(config.file) if config.file else Path(paths[0]).with_suffix(SUFFIXES[config.format])
    if file.suffix != SUFFIXES[config.format]:
        raise UserError(f"file: got {file}, expected a name that ends in {SUFFIXES[config.format]}")
    reference = UnitEnsemble([CheckpointModule(Path(path), config.look_once) for path in paths])
    run = checkpoints[0].config.copy()  # the checkpoint's own stays as it is
    run.cache.folder = config.paths.cache
    run.unit_categories = [name for checkpoint in checkpoints for name in checkpoint.config.unit_categories]
    samples = export.sample_views(run, "val", config.views)
    calibration = (
        export.sample_views(run, "train", CALIBRATION_VIEWS) if config.precision == "int8" else samples
    )
    with replacing(file) as temporary:  # an earlier file stays unless this one is good
        export.export(checkpoints, temporary, config.format, config.precision, calibration, config.look_once)
        check = export.compare(load(temporary), reference, samples)
        told = f"on {len(samples)} views: largest difference {check.difference:.2g}, IoU {check.told()}"
        unseen = set(run.unit_categories) - check.iou.keys()
        if config.precision != "float32" and unseen:
            raise UserError(
                f"views: got {config.views}, but no label of them holds {', '.join(sorted(unseen))}; use more"
            )
        if config.precision == "float32":
            good, limit = check.difference <= config.tolerance, f"a difference of at most {config.tolerance}"
        else:
            good, limit = check.loss <= config.max_loss, f"a loss of IoU of at most {config.max_loss} in each"
        if not good:
            raise UserError(f"{file}: {told}, expected {limit}; nothing is kept, choose another precision")
    log.info("%s, %.1f MB, %s", file, file.stat().st_size / 1e6, told)


if __name__ == "__main__":
    main()
