"""Write a data set of views (litdata shards): `python -m imagination.prepare_shards shards=/data/views split=train`."""

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
from imagination.views.observer import Observer

if TYPE_CHECKING:  # torch takes seconds to import: --help does without
    from imagination.data.shards.writer import ShardSpec

log = logging.getLogger(__name__)


@command("prepare_shards")
def main(config: DictConfig) -> None:
    """Render the views of all scenes of a split into shards; scenes that are complete are kept, failures are logged."""
    if OmegaConf.is_missing(config, "shards"):
        raise UserError("shards: got none, expected the folder to write to: shards=/data/views")
    require_extra("litdata", "shards")
    check_range("parts", config.parts, 1, 1_000_000, "jobs")
    check_range("part", config.part, 0, config.parts - 1)
    from imagination.data.shards import writer

    observer: Observer = instantiate(config.data.observer)
    split = cast(Split, check_choice("split", config.split, SPLITS))
    sampler, group = instantiate(config.data.sampler), config.scale.update_interval
    recipe = writer.ShardSpec(sampler, config.seed, config.views, group)
    folder, scenes = Path(config.shards), observer.source.scenes(split)[config.part :: config.parts]
    folder.mkdir(parents=True, exist_ok=True)
    log_file = folder / f"render_{config.part}_of_{config.parts}.log"
    workers = config.scale.workers
    with logging_to(log_file), writer.at_work(folder):
        left = writer.unwritten(folder, observer, scenes, recipe)
        begin, failed = perf_counter(), []
        with closing(writer.write_scenes(observer, left, folder, recipe, workers)) as done:
            for scene, problem in progress(done, f"views of scenes ({split})", len(left)):
                if problem:
                    failed.append(scene)
                    log.error("%s is left out: %s", scene, problem)
        seconds = perf_counter() - begin
        about = writer.write_index(folder, observer, recipe)
        log_size(folder, about, recipe, len(left) - len(failed), seconds, workers)
        if failed:
            log.error(
                "%d scenes failed: %s; run this again to try them once more", len(failed), ", ".join(failed)
            )
        log.info("Train on them: python -m imagination.train data=shards data.shards=%s", folder)


def log_size(
    folder: Path, about: dict[str, Any], recipe: ShardSpec, written: int, seconds: float, workers: int
) -> None:
    """Log the size of a data set and, where scenes were written, the rate and what a million views would take."""
    count, size = len(about["scenes"]), sum(path.stat().st_size for path in folder.glob("chunk-*.bin"))
    views = count * recipe.views
    log.info("%s: %d scenes, %d views, %.1f kB a view", folder, count, views, size / views / 1e3)
    if written:
        rate = written * recipe.views / seconds
        log.info(
            "%.0f views/s with %d processes, scenes and truth included: a million views take %.1f hours and %.0f GB",
            *(rate, max(1, workers), 1e6 / rate / 3600, size / views * 1e6 / 1e9),
        )


if __name__ == "__main__":
    main()
