"""Replay buffer at small scale: insertion of a collection, sampling of a batch."""

from __future__ import annotations

import numpy as np

from imagination.data.collate import MapCollate
from imagination.data.replay_buffer import ReplayBuffer
from imagination.geometry.morphology import kernel_cells
from imagination.views.collector import Views, render_views
from imagination.views.pose_samplers import UniformPoses
from tests.benchmarks.measure import Figure, copying, medians
from tests.benchmarks.subjects import SEED, config, observer

BATCH = 108
COLLECTION = 80


def views_of_a_scene(folder: str, count: int = COLLECTION) -> Views:
    """Return views of a scene as training collects them."""
    return render_views(observer(folder), "test_0000", UniformPoses(), (SEED, 1), count)


def run(folder: str) -> list[Figure]:
    """Return all figures."""
    run_config = config(folder)
    size, resolution = run_config.callbacks.replay_buffer.size, run_config.ego.resolution
    views = views_of_a_scene(folder)
    buffer = ReplayBuffer(size, run_config.aggregation_factor)
    for _ in range(-(-size // COLLECTION)):
        buffer.insert(views)
    rng = np.random.default_rng(SEED)
    batch = buffer.draw(BATCH, rng)
    kernels = [kernel_cells(run_config.kernels[name], resolution) for name in ("imaginable", "neighbourhood")]
    times = medians(
        {
            "insert": lambda: buffer.insert(views),
            "copy in": copying(*(store[:COLLECTION] for store in buffer._store.values())),
            "draw": lambda: buffer.draw(BATCH, rng),
            "copy out": copying(*batch.values()),
            "assemble": lambda: MapCollate()(batch, [0], *kernels),
        },
        5.0,
    )
    held = sum(store.nbytes for store in buffer._store.values()) / 1e9
    return [
        Figure(
            f"replay buffer: insert a collection of {COLLECTION} views",
            1e3 * times["insert"],
            "ms",
            1e3 * times["copy in"],
            "copying them as they are held, masks as bits",
            note=f"{size} views held in {held:.2f} GB",
        ),
        Figure(
            f"replay buffer: draw a batch of {BATCH}, uint8 delivered",
            1e3 * times["draw"],
            "ms",
            1e3 * times["copy out"],
            "copying it",
            10.0,
            at_most=True,
            note="its images, maps and masks; labels are the next line",
        ),
        Figure(
            f"labels and M*_seen of a batch of {BATCH}, one category",
            1e3 * times["assemble"],
            "ms",
            1e3 * times["copy out"],
            "copying the batch",
        ),
    ]
