"""How long commands take to answer."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

from benchmarks.measure import Figure, medians

COMMANDS = {
    "python -m imagination.train --help": ["-m", "imagination.train", "--help"],
    "python -m imagination.plugins": ["-m", "imagination.plugins"],
}


def run(_: str) -> list[Figure]:
    """All figures."""
    floor = ["-c", "import hydra, numpy, yaml"]
    times = medians({name: starting(words) for name, words in {**COMMANDS, "floor": floor}.items()}, 1.0, 5)
    return [
        Figure(
            f"start-up: `{name}`",
            times[name],
            "s",
            times["floor"],
            "importing hydra, numpy and yaml",
            2.0,
            at_most=True,
        )
        for name in COMMANDS
    ]


def starting(words: list[str]) -> Callable[[], object]:
    """Runs python and waits for it."""
    return lambda: subprocess.run([sys.executable, *words], check=True, capture_output=True)
