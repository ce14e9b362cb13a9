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

UNIT = "unit, resnet18, unet (default)"
"""That is trained, as results name it."""

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

    @classmethod
    def of(cls, results: Results) -> Costs:
        """As measured."""
        one, two = (results.value("shards", f"views written by {n}") for n in (1, 2))
        return cls(
            truth=results.value("shards", "home and truth for a corpus"),
            writing=one,
            efficiency=two / (2 * one),
            size=1e3 * results.value("shards", "size of a view"),
            reading=results.value("shards", "views read by 1 process"),
            training=results.value("training", f"training, {UNIT}", "whole rounds"),
            draws=DRAWS,
            gradients=1e6 * results.value("distributed", "gradients of a step"),
        )

    def rendering(self, machines: int) -> dict[str, float]:
        """Seconds for the corpus. The truth of a home is paid once, whatever the number of its views."""
        work = HOMES * self.truth + VIEWS / self.writing
        return {
            "the processors": work / (CORES * self.efficiency * machines),
            "the storage": VIEWS * self.size / STORAGE,
        }

    def exchanging(self, machines: int) -> float:
        """Seconds of a training step in which gradients are exchanged."""
        return exchange(machines, self.gradients, LINK)

    def step(self, machines: int) -> dict[str, float]:
        """Seconds for a training step on `BATCH` views in each machine: views are read meanwhile."""
        return {
            "computing and exchanging": BATCH / self.training + self.exchanging(machines),
            "the thread that reads shards": BATCH / self.draws / self.reading,
            "the storage": machines * BATCH / self.draws * self.size / STORAGE,
        }

    def epoch(self, machines: int) -> float:
        """Seconds to train on all views."""
        return self.steps(machines) * max(self.step(machines).values())

    def steps(self, machines: int) -> float:
        """Until all views were trained on."""
        return VIEWS * self.draws / (machines * BATCH)


def exchange(processes: int, gradients: float, bandwidth: float) -> float:
    """Seconds of a ring all-reduce, in which each process sends 2 (n - 1) / n times the gradients."""
    return 2 * (processes - 1) / processes * gradients / bandwidth


def first_saturated(busy: Callable[[int], dict[str, float]], most: int = 10_000) -> str:
    """The part that is busier than the work itself, the first part, with the fewest machines."""
    work, *_ = busy(1)
    for machines in range(1, most + 1):
        parts = busy(machines)
        longest = max(parts, key=lambda part: parts[part])
        if longest != work:
            return f"{longest}, from {machines} machine{'s' * (machines > 1)} on"
    return f"nothing before {work}, up to {most:,} machines"


def sizes(machines: int) -> dict[str, int]:
    """With which each process trains as one does by itself at desk scale, until all views were trained on."""
    shared = {name: machines * int(DESK[name]) for name in SHARED}
    return {**shared, "rounds": math.ceil(VIEWS / (DESK["update_interval"] * shared["parallel_scenes"]))}


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
    costs = Costs.of(results)
    return "\n\n".join([unit_costs(results, costs), check(results, costs), table(costs), conclusions(costs)])


def unit_costs(results: Results, costs: Costs) -> str:
    """What everything is predicted from."""
    bandwidth = results.value("distributed", "exchange")
    return f"""\
| unit cost | measured |
|---|---|
| a home and its ground truth | {costs.truth:.1f} s a core |
| a view: rendered, projected, cropped, written | {1e3 / costs.writing:.1f} ms a core |
| size of a view | {costs.size / 1e3:.1f} kB |
| reading shards | {costs.reading:.0f} views/s a process |
| training, default unit, desk scale, batch {BATCH}, whole rounds | {costs.training:.0f} samples/s a machine |
| gradients of its step | {costs.gradients / 1e6:.1f} MB |
| exchanging gradients, 2 processes on one machine | {bandwidth:.0f} MB/s |"""


def check(results: Results, costs: Costs) -> str:
    """What the model says of two processes on this machine, beside what they did."""
    one, two = (
        [
            results.value("shards", f"views written by {count}"),
            results.value("shards", f"views read by {count}"),
            results.value("distributed", "training step", f" {count}"),
        ]
        for count in ("1 process", "2 processes")
    )
    bandwidth = 1e6 * results.value("distributed", "exchange")
    training = 2 * BATCH / (BATCH / one[2] + exchange(2, costs.gradients, bandwidth))
    rows = zip(
        ("views written", "views read", f"training, 1 thread a process, batch {BATCH} each"),
        one,
        (2 * one[0], 2 * one[1], training),
        two,
        strict=True,
    )
    lines = [
        "Two processes on this machine, predicted from one: those that render or read do not meet; those that train",
        "compute as fast as one and then exchange their gradients, at the bandwidth measured without training.",
        "",
        "| | 1 process | 2 predicted | 2 measured | predicted over measured |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {what} | {alone:.1f}/s | {expected:.1f}/s | {together:.1f}/s | {expected / together:.2f} |"
        for what, alone, expected, together in rows
    ]
    return "\n".join(lines)


def table(costs: Costs) -> str:
    """Hours and traffic with more and more machines."""
    lines = [
        f"{HOMES:,} homes and {VIEWS:,} views ({VIEWS * costs.size / 1e12:.2f} TB) on machines of {CORES} cores that "
        "render with a",
        f"process a core, at the measured {costs.efficiency:.0%} of twice one, or train with one process, a batch of "
        f"{BATCH} each:",
        "",
        f"| machines | rendering | written | training, each view {costs.draws:g} times | of it exchanging | read "
        "| trained with |",
        "|---|---|---|---|---|---|---|",
    ]
    for machines in MACHINES:
        hours, epoch = max(costs.rendering(machines).values()) / 3600, costs.epoch(machines) / 3600
        written, read = (VIEWS * costs.size / (3600 * each) / 1e6 for each in (hours, epoch))
        exchanging = costs.steps(machines) * costs.exchanging(machines) / 3600 / epoch
        overrides = " ".join(
            f"scale.{name}={size}" for name, size in sizes(machines).items() if size != DESK[name]
        )
        lines.append(
            f"| {machines} | {hours:.1f} h | {written:.1f} MB/s | {epoch:.1f} h | {exchanging:.0%} | {read:.1f} MB/s "
            f"| `{overrides}` |"
        )
    return "\n".join(lines)


def conclusions(costs: Costs) -> str:
    """What ends the growth."""
    most = math.gcd(*(PAPER[name] for name in SHARED))
    counts = ", ".join(str(count) for count in range(1, most + 1) if most % count == 0)
    asked = costs.training / costs.draws
    return f"""\
What saturates first, by these numbers: in rendering {first_saturated(costs.rendering)};
in training {first_saturated(costs.step)}.
One process reads {costs.reading / asked:.0f} times what a machine's training asks for. No learning rate was chosen for
the larger batches. `scale=paper` goes on {counts} processes as it is."""


def main() -> None:
    """Write the predictions between the marks of the page."""
    page = PAGE.read_text()
    before, rest = page.split(BEGIN)
    text = predicted(Results(json.loads((FOLDER / "results.json").read_text())))
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main()
