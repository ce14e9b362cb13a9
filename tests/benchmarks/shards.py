"""Dataset of shards at small scale: writing and reading by one and two processes."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import mean, median
from time import perf_counter

import numpy as np

from imagination.data.datamodule import count_ground_truth
from imagination.data.shards import writer
from imagination.data.shards.reader import Shards
from imagination.data.shards.writer import ShardSpec, chunk_name
from imagination.utils.errors import require_extra
from imagination.views.observer import Observer
from imagination.views.pose_samplers import UniformPoses
from imagination.views.scene_workers import ScenePool
from tests.benchmarks.ground_truth import tracing
from tests.benchmarks.measure import Figure, copying, medians
from tests.benchmarks.subjects import SEED, config, observer

SCENES, VIEWS = 6, 100
"""Number of scenes, and of views per scene."""

REPETITIONS = 10
"""Number of times that the views of a scene are read in one measurement."""


def run(folder: str) -> list[Figure]:
    """Return all figures."""
    require_extra("litdata", "shards")
    spec = ShardSpec(UniformPoses(), SEED, VIEWS, config(folder).callbacks.replay_buffer.update_interval)
    observers = {workers: observer(f"{folder}/dataset_{workers}") for workers in (1, 2)}
    first, *scenes = observers[1].source.scenes("test")[: SCENES + 1]
    pools = {workers: ScenePool(views, workers) for workers, views in observers.items()}
    folders = {workers: Path(folder, f"dataset_{workers}", "shards") for workers in observers}

    def write(workers: int) -> Callable[[], float]:
        folders[workers].mkdir(parents=True)
        return lambda: rate(pools[workers], workers, writing, scenes, folders[workers], spec)

    def read(workers: int) -> Callable[[], float]:
        return lambda: rate(pools[workers], workers, reading, scenes, folders[1])

    try:
        built = {workers: build_time(pool, first, scenes) for workers, pool in pools.items()}[1]
        traced = mean(pools[1].submit(tracing, scene).result() for scene in scenes)
        render = {"rendered": lambda: rate(pools[1], 1, rendering, scenes, spec)}
        speed = alternating({**render, "written 1": write(1), "written 2": write(2)})
        writer.write_index(folders[1], observers[1], spec)
        speed |= alternating({"read 1": read(1), "read 2": read(2), "copied": copied(folders[1], scenes[0])})
        cold = {"read cold": first_reading, "bare": bare_reading}
        speed |= alternating(
            {name: partial(rate, pools[1], 1, task, scenes, folders[1]) for name, task in cold.items()}
        )
    finally:
        for pool in pools.values():
            pool.close()
    size = sum(path.stat().st_size for path in folders[1].glob("chunk-*.bin")) / (SCENES * VIEWS)
    return figures_of(built, traced, speed, size)


def figures_of(built: float, traced: float, speed: Mapping[str, float], size: float) -> list[Figure]:
    """Return figures of the build time of a scene, the speeds in views/s, and the size of a view in bytes."""
    cached = "chunks in the page cache"
    return [
        Figure(
            "scene and ground truth for a dataset, 1 process",
            built,
            "s",
            traced,
            "bare Embree on its views",
            note=f"mean of {SCENES} scenes, each built once; their views were traced afterwards",
        ),
        Figure(
            "views written by 1 process",
            speed["written 1"],
            "views/s",
            speed["rendered"],
            "rendering alone",
            note="of loaded scenes",
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
            note="the chunk was dropped from the page cache before; caches of the disk or host are unknown",
        ),
    ]


def build_time(pool: ScenePool, first: str, scenes: Sequence[str]) -> float:
    """Return the mean time to build a scene and its ground truth after a warm-up scene, seconds."""
    pool.submit(count_ground_truth, first).result()
    start = perf_counter()
    for task in [pool.submit(count_ground_truth, scene) for scene in scenes]:
        task.result()
    return (perf_counter() - start) / len(scenes)


def alternating(rates: Mapping[str, Callable[[], float]], rounds: int = 3) -> dict[str, float]:
    """Return the median of each rate, measured alternately after a warm-up round."""
    _, *rows = [{name: measure() for name, measure in rates.items()} for _ in range(1 + rounds)]
    return {name: median(row[name] for row in rows) for name in rates}


def rate(
    pool: ScenePool, workers: int, function: Callable[..., float], scenes: Sequence[str], *arguments: object
) -> float:
    """Return the views per second of all workers of a pool; a task returns its seconds per view."""
    tasks = [pool.submit(function, scene, *arguments) for scene in scenes]
    return workers / mean(task.result() for task in tasks)


def rendering(views: Observer, name: str, spec: ShardSpec) -> float:
    """Return the time of the renderer alone, seconds per view; runs in a worker process."""
    scene, renderer = views._load(name)
    poses = spec.sampler(scene, spec.views, np.random.default_rng(spec.seed))
    start = perf_counter()
    for pose in poses:
        renderer.render(views.camera, views.camera.to_world(pose, scene.floor_height))
    return (perf_counter() - start) / spec.views


def writing(views: Observer, scene: str, folder: Path, spec: ShardSpec) -> float:
    """Return the time to write a loaded scene, seconds per view; runs in a worker process."""
    views.scene(scene)
    views.ground_truth(scene)
    start = perf_counter()
    writer.write_scene(views, scene, folder, spec)
    return (perf_counter() - start) / spec.views


def reading(_: Observer, scene: str, folder: Path) -> float:
    """Return the time to read the views of a scene repeatedly, seconds per view; runs in a worker process."""
    shards = Shards(str(folder), "", 1.0)
    shards.read(scene, 0)  # opens the chunk
    start = perf_counter()
    for _repetition in range(REPETITIONS):
        for number in range(shards.scenes[scene]):
            shards.read(scene, number)
    return (perf_counter() - start) / (REPETITIONS * VIEWS)


def first_reading(_: Observer, scene: str, folder: Path) -> float:
    """Return the time to read the views of a scene from disk, seconds per view; runs in a worker process."""
    shards = Shards(str(folder), "", 1.0)
    drop_cache(folder / chunk_name(scene))
    start = perf_counter()
    for number in range(shards.scenes[scene]):
        shards.read(scene, number)
    return (perf_counter() - start) / VIEWS


def bare_reading(_: Observer, scene: str, folder: Path) -> float:
    """Return the time to read a chunk from disk without decoding, seconds per view; runs in a worker process."""
    drop_cache(folder / chunk_name(scene))
    start = perf_counter()
    (folder / chunk_name(scene)).read_bytes()
    return (perf_counter() - start) / VIEWS


def drop_cache(path: Path) -> None:
    """Drop a file from the page cache of the system."""
    with path.open("rb") as file:
        os.fsync(file)
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def copied(folder: Path, scene: str) -> Callable[[], float]:
    """Return a function that measures copies of a group of views in memory, views per second."""
    shards = Shards(str(folder), "", 1.0)
    copy = copying(*shards.read(scene, 0).values())
    return lambda: shards.group / medians({"copy": copy}, 0.5)["copy"]
