"""Evaluate checkpoints: `python -m imagination.evaluate ckpt=outputs/chair_unet/latest/checkpoints/best.ckpt`.

The config is that of the (first) checkpoint's run, changed by the command line; nothing is trained.
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
from imagination.runs.folder import CONFIG, create_folder, now, within
from imagination.runs.logging import logging_to
from imagination.utils.atomic_io import remove_parts, write_errors_reported, write_text
from imagination.utils.errors import UserError

if TYPE_CHECKING:
    from imagination.evaluation.protocol import MappingProtocol
    from imagination.runs.checkpoint import Checkpoint

log = logging.getLogger(__name__)


@command("evaluate")
def main(config: DictConfig) -> None:
    """Evaluate the checkpoints that `ckpt` names."""
    if OmegaConf.is_missing(config, "ckpt") or not config.ckpt:
        raise UserError(
            "ckpt: got none, expected a checkpoint: ckpt=outputs/<experiment>/latest/checkpoints/best.ckpt"
        )
    from imagination.runs.checkpoint import Checkpoint  # with it comes torch, which --help does without

    job = None if OmegaConf.is_missing(config.paths, "run") else Path(config.paths.run)
    paths = [config.ckpt] if isinstance(config.ckpt, str) else list(config.ckpt)
    checkpoints = [Checkpoint.read(path) for path in paths]
    config = evaluation_config(checkpoints, list(HydraConfig.get().overrides.task))
    protocol = instantiate(config.evaluation)  # refuses what is out of range before anything is written
    folder = new_folder(config, job)
    config.paths.run = str(folder)
    found = [str(within(Path(path))) for path in paths]  # `latest` will be another one tomorrow
    config.ckpt = found[0] if isinstance(config.ckpt, str) else found
    with logging_to(folder / "run.log"):
        write_text(folder / CONFIG, OmegaConf.to_yaml(config, resolve=True))
        try:
            evaluate(config, protocol, checkpoints, folder)
        except KeyboardInterrupt:
            log.warning(
                "Interrupted; %s holds no complete result. Runs that are done stay in the cache: the same command "
                "goes on from there.",
                folder,
            )
            sys.exit(130)
        log.info("Results: %s/ (tables/, figures/, maps/)", folder)


def evaluate(
    config: DictConfig, protocol: MappingProtocol, checkpoints: Sequence[Checkpoint], folder: Path
) -> None:
    """Load the networks, look at the scenes, write tables, figures and maps."""
    import torch

    from imagination.evaluation import run
    from imagination.models.segmentation.ade20k import PublicHRNet
    from imagination.reporting.results_folder import write_results
    from imagination.reporting.training_table import training_rows

    data = instantiate(config.data.module)
    check_scenes(checkpoints, data.observer.source)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    networks: list[Any] = [checkpoint.model() for checkpoint in checkpoints]
    if config.ade20k:
        observer, mirrored = data.observer, config.scale.tta_hflip
        networks.append(PublicHRNet.load(Path(config.ade20k), observer.categories, observer.camera, mirrored))
    try:
        evaluation = run.evaluate(protocol, data, [network.to(device) for network in networks], folder)
    finally:
        data.close()
    write_results(
        folder, evaluation, training_rows(checkpoints, evaluation.report, public=bool(config.ade20k))
    )


def new_folder(config: DictConfig, job: Path | None) -> Path:
    """A folder for the results: outputs/<name>/evaluate_<date_time>, or that of a sweep's member."""
    if job is None:
        return create_folder(Path(config.paths.outputs) / config.name, f"evaluate_{now()}")
    with write_errors_reported(job):
        job.mkdir(parents=True, exist_ok=True)
    remove_parts(job)  # of an evaluation that was killed
    return job


if __name__ == "__main__":
    main()
