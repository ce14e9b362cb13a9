"""Evaluate checkpoints: `python -m imagination.evaluate ckpt=outputs/chair_unet/latest/checkpoints/best.ckpt`.

The config is that of the first checkpoint's run with the overrides of the command line; nothing is trained.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.evaluation.checkpoint_config import check_scenes, evaluation_config
from imagination.runs.command import command
from imagination.runs.command_line import command_line, own_arguments
from imagination.runs.final_record import write_final_record
from imagination.runs.folder import CONFIG, resolved_path
from imagination.runs.hydra_folder import describe_run, new_run_folder
from imagination.runs.locking import locked
from imagination.runs.logging import logging_to
from imagination.utils import interrupts
from imagination.utils.atomic_io import remove_parts, write_errors_reported, write_text
from imagination.utils.errors import UserError

if TYPE_CHECKING:
    from imagination.evaluation.protocol import MappingProtocol
    from imagination.runs.checkpoint import Checkpoint

log = logging.getLogger(__name__)


@command("evaluate")
def main(config: DictConfig) -> None:
    """Evaluate the checkpoints in `ckpt`."""
    if OmegaConf.is_missing(config, "ckpt") or not config.ckpt:
        raise UserError(
            "ckpt: got none, expected a checkpoint: ckpt=outputs/<experiment>/latest/checkpoints/best.ckpt"
        )
    from imagination.runs.checkpoint import Checkpoint  # imports torch, which --help does not need

    job_folder = None if OmegaConf.is_missing(config.paths, "run") else Path(config.paths.run)
    paths = [config.ckpt] if isinstance(config.ckpt, str) else list(config.ckpt)
    checkpoints = [Checkpoint.read(path) for path in paths]
    config = evaluation_config(checkpoints, list(HydraConfig.get().overrides.task))
    protocol = instantiate(config.evaluation)  # checks the settings before anything is written
    folder = results_folder(config, job_folder)
    config.paths.run = str(folder)
    resolved = [str(resolved_path(Path(path))) for path in paths]  # `latest` may point to another run later
    config.ckpt = resolved[0] if isinstance(config.ckpt, str) else resolved
    with locked(folder), logging_to(folder / "run.log"):
        remove_parts(folder)  # left by an evaluation that was killed
        write_text(folder / CONFIG, OmegaConf.to_yaml(config, resolve=True))
        try:
            evaluate(config, protocol, checkpoints, folder)
            write_final_record(folder, checkpoints=resolved)
        except KeyboardInterrupt:
            if job_folder is None:
                command = command_line("evaluate", own_arguments())
                interrupts.report(f"Finished trials stay in the cache. Continue with: {command}")
            sys.exit(interrupts.exit_code())
        log.info("Results: %s/ (tables/, figures/, maps/)", folder)


def evaluate(
    config: DictConfig, protocol: MappingProtocol, checkpoints: Sequence[Checkpoint], folder: Path
) -> None:
    """Load the networks, evaluate them on all scenes, and write records, maps, tables and figures."""
    import torch

    from imagination.evaluation import run
    from imagination.evaluation.networks import network_rows
    from imagination.models.segmentation.ade20k import PublicHRNet
    from imagination.reporting.results_folder import write_results

    data = instantiate(config.data.module)
    check_scenes(checkpoints, data.observer.source)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    networks: list[Any] = [checkpoint.model() for checkpoint in checkpoints]
    if config.ade20k:
        observer, hflip = data.observer, config.model.tta_hflip
        networks.append(PublicHRNet.load(Path(config.ade20k), observer.categories, observer.camera, hflip))
    rows = network_rows(checkpoints, config.unit_categories, public=bool(config.ade20k))
    try:
        run.evaluate(protocol, data, [network.to(device) for network in networks], folder, rows)
    finally:
        data.close()
    write_results(folder)


def results_folder(config: DictConfig, job_folder: Path | None) -> Path:
    """Create and return the results folder: that of a sweep's job, or `hydra.run.dir`."""
    if job_folder is None:
        folder = new_run_folder(config, continues=True)
    else:
        folder = job_folder
        with write_errors_reported(folder):
            folder.mkdir(parents=True, exist_ok=True)
        describe_run(folder, config)
    return folder


if __name__ == "__main__":
    main()
