"""`python -m benchmarks.scaling`: what the measured costs predict for many machines, into docs/scaling.md.

Reads benchmarks/results.json. What the model (`Costs`) says of two processes is told beside what they did.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parent
PAGE = FOLDER.parent / "docs" / "scaling.md"
BEGIN, END = "<!-- made by python -m benchmarks.scaling -->", "<!-- end -->"
DESK, PAPER = (
    yaml.safe_load((FOLDER.parent / "conf" / "scale" / f"{name}.yaml").read_text())
    for name in ("desk", "paper")
)

MACHINES = (1, 2, 10, 16, 100)
CORES = 2
"""Of a machine."""

HOMES, VIEWS = 1000, 10_000_000
BATCH: int = DESK["batch_size"]
"""Views that each machine trains on in a step."""

DRAWS: float = DESK["update_batches"] * BATCH / (DESK["update_interval"] * DESK["parallel_scenes"])
"""How often training at desk scale draws each view."""

LINK = STORAGE = 125e6
"""Bytes a second of each machine's network, and of the storage that all share: 1 Gbit/s, an assumption."""

SHARED = ("batch_size", "parallel_scenes", "buffer_size")
"""Sizes of all processes together, which their number has to divide (`imagination.train.check_shares`)."""


@dataclass(frozen=True)
class Costs:
    """What was measured, and how long it predicts that each part is busy.

    Attributes:
        truth: core seconds for a home and its ground truth.
        writing: views a second that one process renders and writes.
        efficiency: of two processes that write: how many times one, halved.
        size: bytes of a view.
        reading: views a second that a process reads.
        training: samples a second of one process that has a machine for itself, in whole rounds.
        draws: how often each view is trained on.
        gradients: bytes of a step's.
    """

    truth: float
    writing: float
    efficiency: float
    size: float
    reading: float
    training: float
    draws: float
    gradients: float

    def rendering(self, machines: int) -> dict[str, float]:
        """Seconds for the corpus. The truth of a home is paid once, whatever the number of its views."""
        work = HOMES * self.truth + VIEWS / self.writing
        return {
            "the processors": work / (CORES * self.efficiency * machines),
            "the storage": VIEWS * self.size / STORAGE,
        }

    def step(self, machines: int) -> dict[str, float]:
        """Seconds for a training step on `BATCH` views in each machine."""
        return {
            "the processors": BATCH / self.training,
            "the network between machines": exchange(machines, self.gradients, LINK),
            "the thread that reads shards": BATCH / self.draws / self.reading,
            "the storage": machines * BATCH / self.draws * self.size / STORAGE,
        }

    def epoch(self, machines: int) -> float:
        """Seconds to train on all views: the exchange follows the computation, views are read meanwhile."""
        computing, exchanging, *meanwhile = self.step(machines).values()
        return self.steps(machines) * max(computing + exchanging, *meanwhile)

    def steps(self, machines: int) -> float:
        """Until all views were trained on."""
        return VIEWS * self.draws / (machines * BATCH)


def exchange(processes: int, gradients: float, bandwidth: float) -> float:
    """Seconds of a ring all-reduce, in which each process sends 2 (n - 1) / n times the gradients."""
    return 2 * (processes - 1) / processes * gradients / bandwidth


def first_saturated(busy: Callable[[int], dict[str, float]], most: int = 10_000) -> str:
    """The part that is busier than the processors with the fewest machines."""
    for machines in range(1, most + 1):
        parts = busy(machines)
        longest = max(parts, key=lambda part: parts[part])
        if longest != "the processors":
            return f"{longest}, from {machines} machine{'s' * (machines > 1)} on"
    return f"nothing before the processors, up to {most:,} machines"


def divisible(machines: int) -> dict[str, int]:
    """The sizes at desk scale with one process on each machine, rounded up to what their number divides."""
    wanted = {**DESK, "batch_size": BATCH * machines}
    return {name: machines * math.ceil(wanted[name] / machines) for name in SHARED}


class Results:
    """Figures of benchmarks/results.json."""

    def __init__(self, results: dict[str, Any]) -> None:
        self.sections = results["sections"]

    def value(self, section: str, starts: str, ends: str = "") -> float:
        """The median of the figure whose name starts and ends so."""
        for figure in self.sections.get(section, {"figures": []})["figures"]:
            what, value = figure["what"], figure["value"]
            if what.startswith(starts) and what.endswith(ends) and value is not None:
                return float(value)
        sys.exit(f"{section}: {starts!r} was not measured; run: python -m benchmarks {section}")


def predicted(results: Results) -> str:
    """Costs, the check and predictions as Markdown."""
    one, two = (results.value("shards", f"views written by {n}") for n in (1, 2))
    alone, together = (
        results.value("distributed", "training step", f" {n}") for n in ("1 process", "2 processes")
    )
    bandwidth = 1e6 * results.value("distributed", "exchange")
    costs = Costs(
        truth=results.value("shards", "home and truth for a corpus"),
        writing=one,
        efficiency=two / (2 * one),
        size=1e3 * results.value("shards", "size of a view"),
        reading=results.value("shards", "views read"),
        training=results.value("training", "training, default unit", "whole rounds"),
        draws=DRAWS,
        gradients=1e6 * results.value("distributed", "gradients of a step"),
    )
    expected = 2 * BATCH / (BATCH / alone + exchange(2, costs.gradients, bandwidth))
    lines = [
        "| unit cost | measured |",
        "|---|---|",
        f"| a home and its ground truth | {costs.truth:.1f} s a core |",
        f"| a view: rendered, projected, cropped, written | {1e3 / one:.1f} ms a core |",
        f"| size of a view | {costs.size / 1e3:.1f} kB |",
        f"| reading shards | {costs.reading:.0f} views/s a process |",
        f"| training, default unit, desk scale, batch {BATCH}, rounds | {costs.training:.0f} samples/s a machine |",
        f"| gradients of its step | {costs.gradients / 1e6:.1f} MB |",
        f"| exchanging gradients, 2 processes on one machine | {bandwidth / 1e6:.0f} MB/s |",
        "",
        "Two processes on this machine, predicted from one: those that render do not meet; those that train compute as",
        "fast as one and then exchange their gradients, at the bandwidth measured without training.",
        "",
        "| | 1 process | 2 predicted | 2 measured | predicted over measured |",
        "|---|---|---|---|---|",
        f"| views written | {one:.1f}/s | {2 * one:.1f}/s | {two:.1f}/s | {2 * one / two:.2f} |",
        f"| training, 1 thread a process, batch {BATCH} each | {alone:.1f}/s | {expected:.1f}/s | {together:.1f}/s "
        f"| {expected / together:.2f} |",
        "",
        f"{HOMES:,} homes and {VIEWS:,} views ({VIEWS * costs.size / 1e12:.2f} TB) on machines of {CORES} cores that "
        "render with a",
        f"process a core, at the measured {costs.efficiency:.0%} of twice one, or train with one process, a batch of "
        f"{BATCH} each:",
        "",
        f"| machines | rendering | written | training on each view {DRAWS:g} times | of it exchanging | read "
        "| sizes that divide |",
        "|---|---|---|---|---|---|---|",
    ]
    for machines in MACHINES:
        hours, epoch = max(costs.rendering(machines).values()) / 3600, costs.epoch(machines) / 3600
        written, read = (VIEWS * costs.size / (3600 * each) / 1e6 for each in (hours, epoch))
        exchanging = (
            costs.steps(machines) * costs.step(machines)["the network between machines"] / 3600 / epoch
        )
        sizes = " ".join(
            f"scale.{name}={size}" for name, size in divisible(machines).items() if size != DESK[name]
        )
        lines.append(
            f"| {machines} | {hours:.1f} h | {written:.1f} MB/s | {epoch:.1f} h | {exchanging:.0%} | {read:.1f} MB/s "
            f"| {f'`{sizes}`' if sizes else 'as configured'} |"
        )
    most = math.gcd(*(PAPER[name] for name in SHARED))
    counts = ", ".join(str(count) for count in range(1, most + 1) if most % count == 0)
    lines += [
        "",
        f"What saturates first, by these numbers: in rendering {first_saturated(costs.rendering)};",
        f"in training {first_saturated(costs.step)}.",
        f"One process reads {costs.reading * DRAWS / costs.training:.0f} times what a machine's training asks for. No "
        "learning rate was chosen for",
        f"the larger batches. `scale=paper` goes on {counts} processes as it is.",
    ]
    return "\n".join(lines)


def main() -> None:
    """Write the predictions between the marks of the page."""
    page = PAGE.read_text()
    before, rest = page.split(BEGIN)
    text = predicted(Results(json.loads((FOLDER / "results.json").read_text())))
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main()
