"""Training step of each unit at small scale: samples and FLOP per second, relative to a matrix product."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np
import torch
from hydra.utils import instantiate
from lightning import Callback, LightningModule, Trainer
from torch import nn
from torch._dynamo.exc import BackendCompilerFailed
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from imagination.data.augmentation import mirrored
from imagination.data.collate import Batch, MapCollate
from imagination.data.replay_buffer import ReplayBuffer
from imagination.geometry.morphology import kernel_cells
from imagination.models.lit_unit import LitUnit
from imagination.runs.resume import Run
from imagination.train import build
from imagination.utils.precision import resolved
from tests.benchmarks.buffer import views_of_a_scene
from tests.benchmarks.measure import Figure, medians, unmeasured
from tests.benchmarks.subjects import SEED, config

UNITS = {
    "unit, resnet18, unet (default)": ("chair_unet", ()),
    "unit, resnet18, fpn": ("chair_unet", ("model/backbone=fpn",)),
    "projected, resnet18, unet": ("chair_unet", ("model=projected",)),
    "shared by 3 categories, resnet18, unet": ("all_shared", ()),
    "ensemble of 3 units, resnet18, unet": ("all_units", ()),
}
"""Experiment and overrides of each unit."""

DEFAULT = UNITS["unit, resnet18, unet (default)"]
TARGETS = {"32-true": 0.45, "bf16-mixed": 0.25}
"""Target fraction of the FLOP/s of a matrix product for the default unit's step, by precision."""

SIDE = 2048
"""Side of the multiplied matrices."""

OPERATORS: dict[str, list[tuple[str, float]]] = {}
"""Fraction of the default unit's step in each operator, by precision; filled by `run`."""


def run(folder: str) -> list[Figure]:
    """Return all figures."""
    figures, speeds = [], {}
    for name, choice in UNITS.items():
        step, speeds[name] = steps(folder, name, choice)
        figures += step
    for name, choice in UNITS.items():  # last, since a training changes global settings of the process
        figures += epochs(folder, name, choice, speeds[name], 9 if choice == DEFAULT else 4)
    return figures


def steps(folder: str, name: str, choice: tuple[str, Sequence[str]]) -> tuple[list[Figure], float]:
    """Measure the training step of a unit in each precision; return figures and the samples/s of precision `auto`."""
    default, figures = choice == DEFAULT, []
    batch = batches(folder, 1 if choice[0] == "chair_unet" else 3)()
    size = len(batch["rgb"])
    for kind in dict.fromkeys(("32-true", resolved("auto"))):
        step, flops = training_step(folder, choice, kind, batch)
        times = medians({"step": step, "product": product(kind)}, 10.0 if default else 5.0, 3)
        figures.append(
            Figure(
                f"training step, {name}, {kind}, batch {size}, {flops / size / 1e9:.2f} GFLOP a sample: "
                f"{size / times['step']:.0f} samples/s",
                flops / times["step"] / 1e9,
                "GFLOP/s",
                2 * SIDE**3 / times["product"] / 1e9,
                f"matrix product of {SIDE}², same type",
                TARGETS[kind] if default else None,
                of_limit=True,
            )
        )
        if default:
            OPERATORS[kind] = operators(step)
    if default:
        figures += engineering(folder, kind, batch, step)
    return figures, size / times["step"]


class Clock(Callback):
    """Callback that records the end time of each epoch, and the fraction of it spent waiting for data."""

    def __init__(self) -> None:
        self.ends: list[float] = []
        self.waiting: list[float] = []

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.ends.append(perf_counter())
        self.waiting.append(float(trainer.callback_metrics["train/waiting"]))


def epochs(
    folder: str, name: str, choice: tuple[str, Sequence[str]], speed: float, count: int
) -> list[Figure]:
    """Measure a training at small scale, whose workers render on the same cores.

    Args:
        folder: folder of the cache.
        name, choice: name of the unit, its experiment and overrides.
        speed: samples/s of its step alone.
        count: number of epochs; the first (warm-up) and the last (validation) are not measured.
    """
    experiment, overrides = choice
    sizes = (
        f"trainer.max_epochs={count}",
        "data.splits={train:16,val:2,test:2}",
        "callbacks.replay_buffer.prefill_steps=20",
        "data.eval_views={val:16,test:16}",
        "trainer.check_val_every_n_epoch=1000",
    )
    # a different seed for each unit, since equal poses would be read from the cache
    seed = f"seed={list(UNITS).index(name)}"
    run_config = config(folder, *overrides, *sizes, seed, experiment=experiment)
    run_config.paths.run = f"{folder}/epochs_{seed}"
    model, data, trainer = build(Run(Path(run_config.paths.run), run_config, None))
    clock = Clock()
    trainer.callbacks.append(clock)
    try:
        data.setup("fit")
        trainer.fit(model, datamodule=data)
    finally:
        data.close()
    samples = run_config.callbacks.replay_buffer.update_batches * run_config.data.batch_size
    what = f"training, {name}, {resolved('auto')}"
    return [
        Figure(
            f"{what}: whole epochs",
            samples / median(np.diff(clock.ends)[:-1].tolist()),
            "samples/s",
            speed,
            "its step alone",
            rival=True,
            note=f"{count - 2} epochs of {samples} samples after a warm-up epoch; {run_config.data.workers} processes "
            "render meanwhile; the step alone was measured before",
        ),
        Figure(
            f"{what}: fraction of an epoch spent waiting for data",
            median(clock.waiting[1:-1]),
            "of the time",
            target=0.05 if choice == DEFAULT else None,
            at_most=True,
            note="waiting for the collection of views, and for batches, which are drawn and collated between steps",
        ),
    ]


def batches(folder: str, layers: int, collections: int = 25) -> Callable[[], Batch]:
    """Return a function that draws a batch at small scale, with the first `layers` categories of the table."""
    run_config = config(folder)
    kernels = [
        kernel_cells(run_config.kernels[name], run_config.ego.resolution)
        for name in ("imaginable", "neighbourhood")
    ]
    buffer = ReplayBuffer(2000, run_config.aggregation_factor)
    views = views_of_a_scene(folder)
    for _ in range(collections):
        buffer.insert(views)
    rng = np.random.default_rng(SEED)

    def draw() -> Batch:
        views = buffer.draw(run_config.data.batch_size, rng)
        flipped = rng.random(run_config.data.batch_size) < run_config.data.hflip_probability
        return MapCollate()(mirrored(views, flipped), list(range(layers)), *kernels)

    return draw


def training_step(
    folder: str,
    choice: tuple[str, Sequence[str]],
    kind: str,
    batch: Batch,
    prepare: Callable[[LitUnit], nn.Module] = lambda module: module,
) -> tuple[Callable[[], None], int]:
    """Return a step as configured (forward, loss, backward, optimiser), and the FLOP of its products and convolutions.

    Args:
        folder: folder of the cache.
        choice: experiment and overrides of the unit.
        kind: precision.
        batch: training batch.
        prepare: function that changes or wraps the module.
    """
    torch.manual_seed(SEED)
    experiment, overrides = choice
    module: LitUnit = instantiate(config(folder, *overrides, experiment=experiment).model.module)
    network = prepare(module)
    optimizer = module.optimizer(module.parameters())

    def autocast() -> AbstractContextManager[object]:
        return torch.autocast("cpu", torch.bfloat16) if kind.startswith("bf16") else nullcontext()

    def step() -> None:
        with autocast():
            loss, _ = module.loss(network(batch), batch["label"], batch["neighbourhood"])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    with FlopCounterMode(display=False) as counter:
        step()
    return step, counter.get_total_flops()


def engineering(folder: str, kind: str, batch: Batch, default: Callable[[], None]) -> list[Figure]:
    """Measure the default unit's step with another memory format and with torch.compile, relative to the default."""

    def contiguous(module: LitUnit) -> nn.Module:
        module.unit.to(memory_format=torch.contiguous_format)
        return module

    def compiled(module: LitUnit) -> nn.Module:
        module.unit.compile()
        return module

    figures = []
    for name, prepare in (("contiguous instead of channels-last", contiguous), ("torch.compile", compiled)):
        what = f"the same with {name}, {kind}"
        try:
            step, _ = training_step(folder, DEFAULT, kind, batch, prepare)
            times = medians({"step": step, "default": default}, 8.0, 3)
        except BackendCompilerFailed as error:
            reason = str(error).splitlines()[0]
            advice = "torch.compile requires a C++ compiler: install g++, or set CXX"
            figures.append(unmeasured(what, f"{advice} ({reason})"))
            continue
        size = len(batch["rgb"])
        speed, configured = size / times["step"], size / times["default"]
        figures.append(Figure(what, speed, "samples/s", configured, "as configured", rival=True))
    return figures


def product(kind: str) -> Callable[[], object]:
    """Return a matrix product with the data type of the step."""
    dtype = torch.bfloat16 if kind.startswith("bf16") else torch.float32
    first, second = (torch.randn(SIDE, SIDE).to(dtype) for _ in range(2))
    return lambda: first @ second


def operators(step: Callable[[], None], count: int = 8) -> list[tuple[str, float]]:
    """Return the fraction of a step's time in each of the `count` slowest operators."""
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        for _ in range(3):
            step()
    rows = profiler.key_averages()
    total = sum(row.self_cpu_time_total for row in rows)
    longest = sorted(rows, key=lambda row: -row.self_cpu_time_total)[:count]
    return [(row.key, row.self_cpu_time_total / total) for row in longest]
