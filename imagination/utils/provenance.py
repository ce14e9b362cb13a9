"""Provenance of results: date, version, git commit, command and processor."""

import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

DISTRIBUTION = "spatial-imagination"
"""Name of the distribution of this project; the `imagination` on PyPI is another project."""


class Provenance(NamedTuple):
    """Provenance of results.

    Attributes:
        date: date and time in UTC, ISO 8601.
        version: version of the package.
        commit: git commit of the checkout, with "-dirty" if its files were changed; empty outside a checkout.
        command: command that computed the results.
        processor: processor, available cores and GPU.
    """

    date: str
    version: str
    commit: str
    command: str
    processor: str


def current_provenance() -> Provenance:
    """Return the provenance of results of this process."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return Provenance(date, package_version(), git_commit(), command_line(), hardware())


def package_version() -> str:
    """Return the version of the installed package; empty if it is not installed."""
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return ""


@cache
def git_commit(folder: Path = Path(__file__).parents[2]) -> str:
    """Return the commit of a checkout, with "-dirty" if tracked files were changed; empty without git or a checkout.

    It is read once, as the code of a process is: call it before a training, during which files may be edited.
    """
    if not (folder / ".git").exists():  # git would look for a checkout in the parent folders
        return ""
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=40"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):  # no git, or a checkout of another user
        return ""
    return done.stdout.strip()


def command_line() -> str:
    """Return the command that this process was started with, quoted for a shell; a console script as its module."""
    name = Path(sys.argv[0]).stem.removeprefix("imagination-").replace("-", "_")
    if not (Path(__file__).parents[1] / f"{name}.py").is_file():
        return shlex.join(["python", *sys.argv])  # a script of the user
    module = "imagination" if name == "__main__" else f"imagination.{name}"
    return shlex.join(["python", "-m", module, *sys.argv[1:]])


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
