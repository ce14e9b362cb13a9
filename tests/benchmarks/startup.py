"""How long commands take to answer."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

from tests.benchmarks.measure import Figure, medians

COMMANDS = {
    "python -m imagination.train --help": (
        ["-m", "imagination.train", "--help"],
        "import hydra, numpy, yaml",
    ),
    "python -m imagination.plugins": (["-m", "imagination.plugins"], "import yaml"),
}
"""Words of each, and what it cannot do without."""


def run(_: str) -> list[Figure]:
    """All figures."""
    started = {name: words for name, (words, _) in COMMANDS.items()}
    started |= {needed: ["-c", needed] for _, needed in COMMANDS.values()}
    times = medians({name: starting(words) for name, words in started.items()}, 1.0, 5)
    return [
        Figure(
            f"start-up: `{name}`",
            times[name],
            "s",
            times[needed],
            f"`python -c '{needed}'`",
            2.0,
            at_most=True,
        )
        for name, (_, needed) in COMMANDS.items()
    ]


def starting(words: list[str]) -> Callable[[], object]:
    """Runs python and waits for it."""
    return lambda: subprocess.run([sys.executable, *words], check=True, capture_output=True)
