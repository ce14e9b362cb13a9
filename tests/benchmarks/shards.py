"""A corpus at small scale: written and read back by one and two processes."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import mean, median
from time import perf_counter

import numpy as np

from imagination.data.datamodule import count_ground_truth
from imagination.data.shards import writer as corpora
from imagination.data.shards.reader import Shards
from imagination.data.shards.writer import ShardSpec, chunk_name
from imagination.utils.errors import require_extra
from imagination.views.observer import Observer
from imagination.views.pose_samplers import UniformPoses
from imagination.views.scene_workers import ScenePool
from tests.benchmarks.measure import Figure, copying, medians
from tests.benchmarks.subjects import SEED, config, observer
from tests.benchmarks.truth import tracing

SCENES, VIEWS = 6, 100
"""That are written, and views of each."""

LAPS = 10
"""That a scene's views are read in a turn."""


def run(folder: str) -> list[Figure]:
    """All figures."""
    require_extra("litdata", "shards")
    recipe = ShardSpec(UniformPoses(), SEED, VIEWS, config(folder).scale.update_interval)
    watchers = {workers: observer(f"{folder}/corpus_{workers}") for workers in (1, 2)}
    first, *scenes = watchers[1].source.scenes("test")[: SCENES + 1]
    pools = {workers: ScenePool(watcher, workers) for workers, watcher in watchers.items()}
    folders = {workers: Path(folder, f"corpus_{workers}", "shards") for workers in watchers}

    def write(workers: int) -> Callable[[], float]:
        folders[workers].mkdir(parents=True)
        return lambda: rate(pools[workers], workers, writing, scenes, folders[workers], recipe)

    def read(workers: int) -> Callable[[], float]:
        return lambda: rate(pools[workers], workers, reading, scenes, folders[1])

    try:
        truth = {workers: built(pool, first, scenes) for workers, pool in pools.items()}[1]
        traced = mean(pools[1].submit(tracing, scene).result() for scene in scenes)
        render = {"rendered": lambda: rate(pools[1], 1, rendering, scenes, recipe)}
        speed = in_turns({**render, "written 1": write(1), "written 2": write(2)})
        corpora.write_index(folders[1], watchers[1], recipe)
        speed |= in_turns({"read 1": read(1), "read 2": read(2), "copied": copied(folders[1], scenes[0])})
        cold = {"read cold": first_reading, "bare": bare_reading}
        speed |= in_turns(
            {name: partial(rate, pools[1], 1, task, scenes, folders[1]) for name, task in cold.items()}
        )
    finally:
        for pool in pools.values():
            pool.close()
    size = sum(path.stat().st_size for path in folders[1].glob("chunk-*.bin")) / (SCENES * VIEWS)
    return figures_of(truth, traced, speed, size)


def figures_of(truth: float, traced: float, speed: Mapping[str, float], size: float) -> list[Figure]:
    """Seconds of a scene, views a second and bytes of a view as figures."""
    cached = "chunks in the page cache"
    return [
        Figure(
            "scene and truth for a corpus, 1 process",
            truth,
            "s",
            traced,
            "bare Embree on its looks",
            note=f"mean of {SCENES} scenes, each made once; their looks were traced afterwards",
        ),
        Figure(
            "views written by 1 process",
            speed["written 1"],
            "views/s",
            speed["rendered"],
            "rendering alone",
            note="of scenes that are loaded",
        ),
        Figure(
            "views written by 2 processes",
            speed["written 2"],
            "views/s",
            2 * speed["written 1"],
            "twice 1 process",
        ),
        Figure("size of a view", size / 1e3, "kB"),
        Figure(
            f"views read by 1 process, {cached}",
            speed["read 1"],
            "views/s",
            speed["copied"],
            "copying their arrays",
        ),
        Figure(
            f"views read by 2 processes, {cached}",
            speed["read 2"],
            "views/s",
            2 * speed["read 1"],
            "twice 1 process",
        ),
        Figure(
            "views read by 1 process, chunks on disk",
            speed["read cold"],
            "views/s",
            speed["bare"],
            "reading the file alone",
            note="the system was told to forget the chunk before; what its disk or host keeps of it is not known",
        ),
    ]


def built(pool: ScenePool, first: str, scenes: Sequence[str]) -> float:
    """Seconds that a scene and its truth take, after the first, before which the workers import."""
    pool.submit(count_ground_truth, first).result()
    start = perf_counter()
    for task in [pool.submit(count_ground_truth, scene) for scene in scenes]:
        task.result()
    return (perf_counter() - start) / len(scenes)


def in_turns(rates: Mapping[str, Callable[[], float]], turns: int = 3) -> dict[str, float]:
    """Median of each rate, after one turn to warm up."""
    _, *rows = [{name: measure() for name, measure in rates.items()} for _ in range(1 + turns)]
    return {name: median(row[name] for row in rows) for name in rates}


def rate(
    pool: ScenePool, workers: int, task: Callable[..., float], scenes: Sequence[str], *arguments: object
) -> float:
    """Views a second of a pool's workers together, each of which tells its seconds a view."""
    tasks = [pool.submit(task, scene, *arguments) for scene in scenes]
    return workers / mean(each.result() for each in tasks)


def rendering(watcher: Observer, scene: str, recipe: ShardSpec) -> float:
    """Seconds a view that the renderer alone takes, for as many random poses; runs in a worker process."""
    scene, renderer = watcher._load(scene)
    poses = recipe.sampler(scene, recipe.views, np.random.default_rng(recipe.seed))
    start = perf_counter()
    for pose in poses:
        renderer.render(watcher.camera, watcher.camera.to_world(pose, scene.floor_height))
    return (perf_counter() - start) / recipe.views


def writing(watcher: Observer, scene: str, corpus: Path, recipe: ShardSpec) -> float:
    """Seconds a view to write a scene anew once it and its truth are loaded; runs in a worker process."""
    watcher.scene(scene)
    watcher.ground_truth(scene)
    start = perf_counter()
    corpora.write_scene(watcher, scene, corpus, recipe)
    return (perf_counter() - start) / recipe.views


def reading(_: Observer, scene: str, corpus: Path) -> float:
    """Seconds a view to read a scene's, again and again; runs in a worker process."""
    read = Shards(str(corpus), "", 1.0)
    read.read(scene, 0)  # opens the chunk
    start = perf_counter()
    for _lap in range(LAPS):
        for number in range(read.scenes[scene]):
            read.read(scene, number)
    return (perf_counter() - start) / (LAPS * VIEWS)


def first_reading(_: Observer, scene: str, corpus: Path) -> float:
    """Seconds a view to read a scene's from disk; runs in a worker process."""
    read = Shards(str(corpus), "", 1.0)
    forget(corpus / chunk_name(scene))
    start = perf_counter()
    for number in range(read.scenes[scene]):
        read.read(scene, number)
    return (perf_counter() - start) / VIEWS


def bare_reading(_: Observer, scene: str, corpus: Path) -> float:
    """Seconds a view to read a scene's chunk from disk, nothing decoded; runs in a worker process."""
    forget(corpus / chunk_name(scene))
    start = perf_counter()
    (corpus / chunk_name(scene)).read_bytes()
    return (perf_counter() - start) / VIEWS


def forget(path: Path) -> None:
    """Let the system's page cache drop a file."""
    with path.open("rb") as file:
        os.fsync(file)
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def copied(corpus: Path, scene: str) -> Callable[[], float]:
    """Copies a group of views in memory: views a second."""
    read = Shards(str(corpus), "", 1.0)
    copy = copying(*read.read(scene, 0).values())
    return lambda: read.group / medians({"copy": copy}, 0.5)["copy"]
