"""A corpus at desk scale: written by one and two processes, read back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    recipe = Recipe(UniformPoses(), SEED, VIEWS, config(folder).scale.update_interval)
    watchers = {workers: observer(f"{folder}/corpus_{workers}") for workers in (1, 2)}
    homes = watchers[1].source.scenes("test")[: HOMES + 1]
    pools = {workers: ScenePool(watcher, workers) for workers, watcher in watchers.items()}
    corpora_of = {workers: Path(folder, f"corpus_{workers}", "shards") for workers in watchers}
    try:
        truth = {workers: built(pool, homes) for workers, pool in pools.items()}[1]
        seconds = medians(
            {
                str(workers): writing(pools[workers], homes[1:], corpora_of[workers], recipe)
                for workers in pools
            },
            least=3,
        )
    finally:
        for pool in pools.values():
            pool.close()
    corpus = corpora_of[1]
    corpora.write_index(corpus, watchers[1], recipe)
    size = sum(path.stat().st_size for path in corpus.glob("chunk-*.bin")) / (HOMES * VIEWS)
    read = Shards(str(corpus), "", 1.0)
    home = next(iter(read.homes))
    times = medians({"read": reading(read, home), "copy": copying(*read.read(home, 0).values())}, 2.0)
    one, two = (HOMES * VIEWS / seconds[workers] for workers in ("1", "2"))
    return [
        Figure(
            "home and truth for a corpus, 1 process", truth, "s a home", note=f"mean of {HOMES} homes, once"
        ),
        Figure("views written by 1 process", one, "views/s"),
        Figure("views written by 2 processes", two, "views/s", 2 * one, "twice 1 process"),
        Figure("size of a view", size / 1e3, "kB"),
        Figure(
            "views read by 1 process, chunks in the page cache",
            recipe.group / times["read"],
            "views/s",
            recipe.group / times["copy"],
            "copying their arrays",
        ),
    ]


def built(pool: ScenePool, homes: Sequence[str]) -> float:
    """Seconds that a home and its truth take, of all but the first, before which the workers import."""
    pool.submit(count_truth, homes[0]).result()
    start = perf_counter()
    for task in [pool.submit(count_truth, home) for home in homes[1:]]:
        task.result()
    return (perf_counter() - start) / len(homes[1:])


def writing(pool: ScenePool, homes: Sequence[str], corpus: Path, recipe: Recipe) -> Callable[[], None]:
    """Writes the homes' views, each home anew."""
    corpus.mkdir(parents=True)

    def write() -> None:
        for task in [pool.submit(corpora.write_home, home, corpus, recipe) for home in homes]:
            task.result()

    return write


def reading(read: Shards, home: str) -> Callable[[], object]:
    """Reads one group of views after the other."""
    numbers = count()
    return lambda: read.read(home, next(numbers) % read.homes[home])
