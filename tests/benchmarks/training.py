"""A training step of each unit at small scale: samples and FLOP a second, beside a plain matrix product's."""

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
from imagination.data.collate import Batch, assemble
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
    "3 units side by side, resnet18, unet": ("all_units", ()),
}
"""An experiment and overrides of each."""

DEFAULT = UNITS["unit, resnet18, unet (default)"]
SHARES = {"32-true": 0.45, "bf16-mixed": 0.25}
"""Of a matrix product's FLOP/s that the default unit's step should reach."""

SIDE = 2048
"""Of the matrices multiplied."""

OPERATORS: dict[str, list[tuple[str, float]]] = {}
"""Share of the default unit's step that each operator takes, in each precision; filled in by `run`."""


def run(folder: str) -> list[Figure]:
    """All figures."""
    figures, speeds = [], {}
    for name, choice in UNITS.items():
        step, speeds[name] = steps(folder, name, choice)
        figures += step
    for name, choice in UNITS.items():  # last, as a training sets much in its process
        figures += epochs(folder, name, choice, speeds[name], 9 if choice == DEFAULT else 4)
    return figures


def steps(folder: str, name: str, choice: tuple[str, Sequence[str]]) -> tuple[list[Figure], float]:
    """A unit's training step alone in each precision; the samples a second of the one that `auto` is here."""
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
                SHARES[kind] if default else None,
                of_limit=True,
            )
        )
        if default:
            OPERATORS[kind] = operators(step)
    if default:
        figures += engineering(folder, kind, batch, step)
    return figures, size / times["step"]


class Clock(Callback):
    """When each round of a training ended, and the share of it that waited for data."""

    def __init__(self) -> None:
        self.ends: list[float] = []
        self.waiting: list[float] = []

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.ends.append(perf_counter())
        self.waiting.append(float(trainer.callback_metrics["train/waiting"]))


def epochs(
    folder: str, name: str, choice: tuple[str, Sequence[str]], speed: float, count: int
) -> list[Figure]:
    """The training itself at small scale: its workers render on the cores that it trains on.

    Args:
        folder: of the cache.
        name, choice: the unit.
        speed: samples a second of its step alone.
        count: epochs; the first warms up and the last one is validated, neither is counted.
    """
    experiment, overrides = choice
    sizes = (
        f"scale.epochs={count}",
        "scale.scenes={train:16,val:2,test:2}",
        "scale.prefill_steps=20",
        "scale.eval_views={val:16,test:16}",
        "scale.eval_every=1000",
    )
    # with poses of its own: the cache would have those that another unit looked from
    seed = f"seed={list(UNITS).index(name)}"
    run = config(folder, *overrides, *sizes, seed, experiment=experiment)
    run.paths.run = f"{folder}/rounds_{seed}"
    model, data, trainer = build(Run(Path(run.paths.run), run, None))
    clock = Clock()
    trainer.callbacks.append(clock)
    try:
        data.setup("fit")
        trainer.fit(model, datamodule=data)
    finally:
        data.close()
    samples, kind = run.scale.update_batches * run.scale.batch_size, resolved("auto")
    what = f"training, {name}, {kind}"
    return [
        Figure(
            f"{what}: whole epochs",
            samples / median(np.diff(clock.ends)[:-1].tolist()),
            "samples/s",
            speed,
            "its step alone",
            rival=True,
            note=f"{count - 2} epochs of {samples} samples after a first one, {run.scale.workers} processes render "
            "meanwhile; the step alone was measured before",
        ),
        Figure(
            f"{what}: share of a round that waits for data",
            median(clock.waiting[1:-1]),
            "of the time",
            target=0.05 if choice == DEFAULT else None,
            at_most=True,
            note="for its collection, and for its batches, which are drawn and assembled between steps",
        ),
    ]


def batches(folder: str, layers: int, collections: int = 25) -> Callable[[], Batch]:
    """What makes a batch at small scale, of the first so many categories of the table."""
    desk = config(folder)
    kernels = [
        kernel_cells(desk.kernels[name], desk.scale.resolution) for name in ("imaginable", "neighbourhood")
    ]
    buffer = ReplayBuffer(2000, desk.aggregation_factor)
    views = views_of_a_scene(folder)
    for _ in range(collections):
        buffer.insert(views)
    rng = np.random.default_rng(SEED)

    def draw() -> Batch:
        views = buffer.draw(desk.scale.batch_size, rng)
        which = rng.random(desk.scale.batch_size) < desk.scale.hflip_probability
        return assemble(mirrored(views, which), list(range(layers)), *kernels)

    return draw


def training_step(
    folder: str,
    choice: tuple[str, Sequence[str]],
    kind: str,
    batch: Batch,
    prepare: Callable[[LitUnit], nn.Module] = lambda module: module,
) -> tuple[Callable[[], None], int]:
    """One step as configured (forward, loss, backward, optimiser), and the FLOP of its products and convolutions.

    Args:
        folder: of the cache.
        choice: experiment and overrides.
        kind: precision.
        batch: trained on.
        prepare: changes the module, or wraps it in what is to be called.
    """
    torch.manual_seed(SEED)
    experiment, overrides = choice
    module: LitUnit = instantiate(config(folder, *overrides, experiment=experiment).model.module)
    network = prepare(module)
    optimizer = module.optimizer(module.parameters())

    def casting() -> AbstractContextManager[object]:
        return torch.autocast("cpu", torch.bfloat16) if kind.startswith("bf16") else nullcontext()

    def step() -> None:
        with casting():
            loss, _ = module.loss(network(batch), batch["label"], batch["neighbourhood"])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()

    with FlopCounterMode(display=False) as counter:
        step()
    return step, counter.get_total_flops()


def engineering(folder: str, kind: str, batch: Batch, default: Callable[[], None]) -> list[Figure]:
    """What memory formats and torch.compile change of the default unit's step, in turns with it."""

    def planar(module: LitUnit) -> nn.Module:
        module.unit.to(memory_format=torch.contiguous_format)
        return module

    def compiled(module: LitUnit) -> nn.Module:
        module.unit.compile()
        return module

    figures = []
    for name, prepare in (("contiguous instead of channels-last", planar), ("torch.compile", compiled)):
        what = f"the same with {name}, {kind}"
        try:
            step, _ = training_step(folder, DEFAULT, kind, batch, prepare)
            times = medians({"step": step, "default": default}, 8.0, 3)
        except BackendCompilerFailed as error:
            reason = str(error).splitlines()[0]
            needed = "torch.compile needs a C++ compiler: install g++, or name one in CXX"
            figures.append(unmeasured(what, f"{needed} ({reason})"))
            continue
        size = len(batch["rgb"])
        speed, configured = size / times["step"], size / times["default"]
        figures.append(Figure(what, speed, "samples/s", configured, "as configured", rival=True))
    return figures


def product(kind: str) -> Callable[[], object]:
    """A plain matrix product of the type that the step computes in."""
    dtype = torch.bfloat16 if kind.startswith("bf16") else torch.float32
    one, other = (torch.randn(SIDE, SIDE).to(dtype) for _ in range(2))
    return lambda: one @ other


def operators(step: Callable[[], None], most: int = 8) -> list[tuple[str, float]]:
    """Share of a step's time by operator, longest first."""
    with profile(activities=[ProfilerActivity.CPU]) as recorded:
        for _ in range(3):
            step()
    rows = recorded.key_averages()
    total = sum(row.self_cpu_time_total for row in rows)
    longest = sorted(rows, key=lambda row: -row.self_cpu_time_total)[:most]
    return [(row.key, row.self_cpu_time_total / total) for row in longest]
