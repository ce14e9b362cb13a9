"""A corpus at desk scale: written by one and two processes, read back."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from pathlib import Path
from time import perf_counter

from benchmarks.measure import Figure, copying, medians
from benchmarks.subjects import SEED, config, observer
from imagination.data import corpus as corpora
from imagination.data.corpus import Recipe
from imagination.data.datamodule import count_truth
from imagination.data.shards import Shards
from imagination.errors import require_extra
from imagination.views.pool import ScenePool
from imagination.views.samplers import UniformPoses

HOMES = 8
VIEWS = 100


def run(folder: str) -> list[Figure]:
    """All figures."""
    require_extra("litdata", "shards")
    group = config(folder).scale.update_interval
    recipe = Recipe(UniformPoses(), SEED, VIEWS, group)
    made = {workers: written(f"{folder}/corpus_{workers}", workers, recipe) for workers in (1, 2)}
    corpus = Path(folder, "corpus_1", "shards")
    size = sum(path.stat().st_size for path in corpus.glob("chunk-*.bin")) / (HOMES * VIEWS)
    read = Shards(str(corpus), "", 1.0)
    home = next(iter(read.homes))
    times = medians({"read": reading(read, home), "copy": copying(*read.read(home, 0).values())}, 2.0)
    once = "once, not a median"
    return [
        Figure("home and truth for a corpus, 1 process", made[1][0], "s a home", note=once),
        Figure("views written by 1 process", made[1][1], "views/s", note=once),
        Figure(
            "views written by 2 processes",
            made[2][1],
            "views/s",
            2 * made[1][1],
            "twice 1 process",
            note=once,
        ),
        Figure("size of a view", size / 1e3, "kB"),
        Figure(
            "views read by 1 process, chunks in the page cache",
            group / times["read"],
            "views/s",
            group / times["copy"],
            "copying their arrays",
        ),
    ]


def written(folder: str, workers: int, recipe: Recipe) -> tuple[float, float]:
    """Seconds that a home and its truth take, and views a second from then on."""
    watcher = observer(folder)
    corpus, homes = Path(folder, "shards"), watcher.source.scenes("test")[:HOMES]
    corpus.mkdir(parents=True)
    pool = ScenePool(watcher, workers)
    try:
        pool.submit(
            count_truth, watcher.source.scenes("test")[HOMES]
        ).result()  # the workers' imports are done
        start = perf_counter()
        for counted in [pool.submit(count_truth, home) for home in homes]:
            counted.result()
        middle = perf_counter()
        for task in [pool.submit(corpora.write_home, home, corpus, recipe) for home in homes]:
            task.result()
        end = perf_counter()
    finally:
        pool.close()
    corpora.write_index(corpus, watcher, recipe)
    return (middle - start) / HOMES, HOMES * recipe.views / (end - middle)


def reading(read: Shards, home: str) -> Callable[[], object]:
    """Reads one group of views after the other."""
    numbers = count()
    return lambda: read.read(home, next(numbers) % read.homes[home])
