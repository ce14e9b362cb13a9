"""Start-up time of commands."""

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
    "python -m imagination.plugins": (["-m", "imagination.plugins"], "import hydra, yaml"),
    "python -m imagination": (["-m", "imagination"], "import ast, difflib"),
}
"""Arguments of each command, and the imports that it requires."""


def run(_: str) -> list[Figure]:
    """Return all figures."""
    programs = {name: arguments for name, (arguments, _) in COMMANDS.items()}
    programs |= {imports: ["-c", imports] for _, imports in COMMANDS.values()}
    times = medians({name: starting(arguments) for name, arguments in programs.items()}, 1.0, 5)
    return [
        Figure(
            f"start-up: `{name}`",
            times[name],
            "s",
            times[imports],
            f"`python -c '{imports}'`",
            2.0,
            at_most=True,
        )
        for name, (_, imports) in COMMANDS.items()
    ]


def starting(arguments: list[str]) -> Callable[[], object]:
    """Return a function that runs Python and waits for its end."""
    return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
