"""Render a dataset of views (litdata shards): `python -m imagination.prepare_shards shards=/data/views split=train`."""

from __future__ import annotations

import logging
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, cast

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.runs.command import command
from imagination.runs.logging import logging_to
from imagination.scenes.source import SPLITS, Split
from imagination.utils.errors import UserError, check_choice, check_range, require_extra
from imagination.utils.progress import progress

if TYPE_CHECKING:  # imports torch, which --help does not need
    from imagination.data.shards.writer import ShardSpec
    from imagination.views.observer import Observer

log = logging.getLogger(__name__)


@command("prepare_shards")
def main(config: DictConfig) -> None:
    """Render the views of all scenes of a split into shards; complete scenes are skipped, failed ones are logged."""
    if OmegaConf.is_missing(config, "shards"):
        raise UserError("shards: got none, expected the folder to write to: shards=/data/views")
    require_extra("litdata", "shards")
    check_range("parts", config.parts, 1, 1_000_000, "jobs")
    check_range("part", config.part, 0, config.parts - 1)
    from imagination.data.shards import writer

    observer: Observer = instantiate(config.data.observer)
    split = cast(Split, check_choice("split", config.split, SPLITS))
    sampler, group = instantiate(config.data.sampler), config.callbacks.replay_buffer.update_interval
    spec = writer.ShardSpec(sampler, config.seed, config.views, group)
    folder, scenes = Path(config.shards), observer.source.scenes(split)[config.part :: config.parts]
    folder.mkdir(parents=True, exist_ok=True)
    log_file = folder / f"render_{config.part}_of_{config.parts}.log"
    workers = config.data.workers
    with logging_to(log_file), writer.at_work(folder):
        missing = writer.unwritten(folder, observer, scenes, spec)
        start, failed = perf_counter(), []
        with closing(writer.write_scenes(observer, missing, folder, spec, workers)) as results:
            for scene, problem in progress(results, f"views of scenes ({split})", len(missing)):
                if problem:
                    failed.append(scene)
                    log.error("scene %s is left out: %s", scene, problem)
        seconds = perf_counter() - start
        index = writer.write_index(folder, observer, spec)
        log_size(folder, index, spec, len(missing) - len(failed), seconds, workers)
        if failed:
            log.error(
                "%d scenes failed: %s; run the same command again to retry them",
                len(failed),
                ", ".join(failed),
            )
        log.info("Train on this dataset: python -m imagination.train data=shards data.shards=%s", folder)


def log_size(
    folder: Path, index: dict[str, Any], spec: ShardSpec, written: int, seconds: float, workers: int
) -> None:
    """Log the size of a dataset and, if scenes were written, the rendering rate and an estimate for 10^6 views.

    Args:
        folder: folder of the dataset.
        index: index of the dataset.
        spec: specification of the shards.
        written: number of scenes written by this process.
        seconds: time for these scenes.
        workers: number of worker processes.
    """
    count, size = len(index["scenes"]), sum(path.stat().st_size for path in folder.glob("chunk-*.bin"))
    views = count * spec.views
    log.info("%s: %d scenes, %d views, %.1f kB per view", folder, count, views, size / views / 1e3)
    if written:
        rate = written * spec.views / seconds
        log.info(
            "%.0f views/s with %d processes, including scenes and ground truth: 10^6 views need %.1f hours and %.0f GB",
            *(rate, max(1, workers), 1e6 / rate / 3600, size / views * 1e6 / 1e9),
        )


if __name__ == "__main__":
    main()
