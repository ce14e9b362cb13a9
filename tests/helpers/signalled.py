"""Run a command that receives a signal at a moment: `python -m tests.helpers.signalled SIGTERM training 3 train …`."""

import os
import runpy
import signal
import sys
import threading
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

MOMENTS = {
    "collection": ("imagination.views.collector", "Collector.start"),
    "training": ("imagination.models.lit_unit", "LitUnit.training_step"),
    "checkpoint": ("os", "replace"),  # last.ckpt is written and about to replace the old one
    "logging": ("os", "replace"),  # last.ckpt is replaced, and the metrics of its epoch are not logged
    "evaluation": ("imagination.evaluation.saved_maps", "save"),
    "summary": ("imagination.runs.run_summary", "peak_memory"),  # after the tables
}
"""Module and function during which the signal arrives."""


def signalled(number: int, function: Callable[..., Any], moment: str, call: int) -> Callable[..., Any]:
    """Return the function with a signal in its n-th call, and the same signal again 0.1 s later."""
    calls = 0

    def send() -> None:
        os.kill(os.getpid(), number)

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        counts = function is not os_replace or Path(args[1]).name == "last.ckpt"
        calls += counts
        if not counts or calls != call:
            return function(*args, **kwargs)
        if moment == "logging":
            function(*args, **kwargs)
        threading.Timer(0.1, send).start()
        send()
        return None if moment == "logging" else function(*args, **kwargs)

    return wrapped


os_replace = os.replace

if __name__ == "__main__":
    name, moment, call, command, *arguments = sys.argv[1:]
    module, path = MOMENTS[moment][0], MOMENTS[moment][1].split(".")
    owner: Any = import_module(module)
    for part in path[:-1]:
        owner = getattr(owner, part)
    setattr(owner, path[-1], signalled(getattr(signal, name), getattr(owner, path[-1]), moment, int(call)))
    sys.argv = [f"imagination.{command}", *arguments]
    runpy.run_module(f"imagination.{command}", run_name="__main__", alter_sys=True)
