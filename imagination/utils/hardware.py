"""Description of the hardware and of the current command, for tables and reports."""

import os
import platform
import shlex
import sys
from pathlib import Path


def command_line() -> str:
    """Return the command that this process was started with, quoted for a shell; a console script as its module."""
    name = Path(sys.argv[0]).stem.removeprefix("imagination-").replace("-", "_")
    return shlex.join(["python", "-m", f"imagination.{name}", *sys.argv[1:]])


def hardware() -> str:
    """Return a description of the processor, the available cores and the GPU."""
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{_processor()}, {cores} cores, {gpu}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
