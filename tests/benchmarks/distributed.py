"""Training step of one process and of two that exchange gradients, and the exchange alone; one thread each."""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from statistics import median
from time import perf_counter

import torch
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel

from imagination.utils.precision import resolved
from tests.benchmarks.measure import Figure
from tests.benchmarks.training import DEFAULT, SIDE, batches, product, training_step

ROUNDS, CALLS = 9, 4
"""Number of rounds, and calls of each function in a round."""


def run(folder: str) -> list[Figure]:
    """Return all figures."""
    batch = batches(folder, layers=1, collections=1)()
    torch.save(batch, f"{folder}/batch.pt")
    alone, *pair = workers = [Worker(folder, *place) for place in ((0, 1), (0, 2), (1, 2))]
    try:
        parameters, flops = {worker.pipe.recv() for worker in workers}.pop()
        turns = {
            "alone": lambda: measured([alone], "step"),
            "product": lambda: measured([alone], "product"),
            "together": lambda: measured(pair, "step"),
            "exchange": lambda: measured(pair, "exchange"),
            "copy": lambda: measured([alone], "copy"),
        }
        rows = [{name: turn() for name, turn in turns.items()} for _ in range(ROUNDS)]
    finally:
        for worker in workers:
            worker.close()
    times = {name: median(row[name] for row in rows) for name in turns}
    size, gradients = len(batch["rgb"]), 4 * parameters
    step = f"training step, default unit, {resolved('auto')}, batch {size} and 1 thread a process"
    return [
        Figure(
            f"{step}, 1 process",
            size / times["alone"],
            "samples/s",
            size / flops * 2 * SIDE**3 / times["product"],
            f"its FLOP at the rate of a matrix product of {SIDE}² on 1 thread",
        ),
        Figure(
            f"{step}, 2 processes",
            2 * size / times["together"],
            "samples/s",
            2 * size / times["alone"],
            "twice 1 process",
            note="DistributedDataParallel over gloo on this machine",
        ),
        Figure("gradients of a step", gradients / 1e6, "MB", note=f"{parameters:,} parameters of 4 bytes"),
        Figure(
            "exchange of a step's gradients alone, 2 processes",
            gradients / times["exchange"] / 1e6,
            "MB/s",
            gradients / times["copy"] / 1e6,
            "copying them in memory",
        ),
    ]


class Worker:
    """Process that measures requested functions.

    Args:
        folder: folder of the batch and of the rendezvous file of the group.
        number: rank of the process.
        count: number of processes that train together.
    """

    def __init__(self, folder: str, number: int, count: int) -> None:
        context = get_context("spawn")
        self.pipe, worker_pipe = context.Pipe()
        self._process = context.Process(target=work, args=(worker_pipe, folder, number, count), daemon=True)
        self._process.start()
        worker_pipe.close()  # so that the end of the process closes the pipe

    def close(self) -> None:
        """Kill the process; gloo sometimes aborts at exit."""
        self._process.kill()
        self._process.join()


def measured(workers: list[Worker], function: str) -> float:
    """Return the median time of a joint call in the slowest worker, seconds."""
    for worker in workers:
        worker.pipe.send(function)
    return max(float(worker.pipe.recv()) for worker in workers)


def work(pipe: Connection, folder: str, number: int, count: int) -> None:
    """Send the number of parameters and the FLOP of a step, then measure the requested functions."""
    torch.set_num_threads(1)
    if count > 1:
        rendezvous = f"file://{folder}/rendezvous"
        distributed.init_process_group("gloo", init_method=rendezvous, rank=number, world_size=count)
    parameters = 0

    def prepare(module: nn.Module) -> nn.Module:
        nonlocal parameters
        parameters = sum(weight.numel() for weight in module.parameters() if weight.requires_grad)
        return DistributedDataParallel(module) if count > 1 else module

    batch, kind = torch.load(f"{folder}/batch.pt", weights_only=True), resolved("auto")
    step, flops = training_step(folder, DEFAULT, kind, batch, prepare)
    gradients = torch.zeros(parameters)
    target = torch.empty_like(gradients)
    calls: dict[str, Callable[[], object]] = {
        "step": step,
        "product": product(kind),
        "exchange": lambda: distributed.all_reduce(gradients),
        "copy": lambda: target.copy_(gradients),
    }
    pipe.send((parameters, flops))
    while True:
        call = calls[pipe.recv()]
        call()  # synchronises the workers and warms the caches
        times = []
        for _ in range(CALLS):
            start = perf_counter()
            call()
            times.append(perf_counter() - start)
        pipe.send(median(times))
