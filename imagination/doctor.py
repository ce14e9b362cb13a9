"""Whether this machine has what the program needs: `python -m imagination.doctor`."""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from imagination.config.plugin_registry import discover, provided
from imagination.utils.diagnostics import Finding

GROUP = "doctor"
"""Folder of a plugin's conf tree: each file's `_target_` is a function that yields findings."""
MEMORY, DISK = 8.0, 5.0
"""What the default job takes, GB."""


def examine() -> Iterator[Finding]:
    """The core's own findings."""
    good = sys.version_info >= (3, 11)
    yield Finding("python", good, f"{sys.version.split()[0]}{'' if good else ', expected 3.11 or later'}")
    for package in ("torch", "lightning", "embreex", "numba", "opencv-python-headless"):
        yield _package(package)
    yield _graphics()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    yield Finding("cores", cores >= 2, f"{cores}{'' if cores >= 2 else '; the default job is made for 2'}")
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    yield Finding("memory", memory >= MEMORY, f"{memory:.0f} GB (the default job takes about 5)")
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    yield Finding(
        "disk", free >= DISK, f"{free:.0f} GB free in {Path.cwd()} (outputs go here; set paths.outputs)"
    )


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, version(name))
    except PackageNotFoundError:
        return Finding(name, False, "not installed; run `make setup`")


def _graphics() -> Finding:
    try:
        import torch
    except ImportError as error:
        return Finding("GPU", False, f"torch cannot be imported: {error}")
    if torch.cuda.is_available():
        return Finding("GPU", True, torch.cuda.get_device_name(0))
    return Finding("GPU", None, "none that CUDA can use; everything runs on the CPU")


def of_plugins() -> Iterator[Finding]:
    """Findings about the plugins, and their own."""
    for plugin in discover():
        yield Finding(f"plugin {plugin.name}", not plugin.problem, plugin.problem or plugin.origin)
    for plugin_name, _, target in provided(GROUP):
        yield from _look(plugin_name, target)


def _look(plugin: str, target: str) -> Iterator[Finding]:
    from hydra.utils import get_method

    try:
        function: Callable[[], Iterator[Finding]] = get_method(target)
        yield from function()
    except Exception as error:  # a stranger's code may raise anything, and the others must still be told
        yield Finding(f"plugin {plugin}", False, f"{target}: {type(error).__name__}: {error}")


def main() -> int:
    """Print all findings; the exit code is 1 if something that is needed is wrong."""
    findings = [*examine(), *of_plugins()]
    marks = {True: "ok", None: "--", False: "!!"}
    width = max(len(finding.name) for finding in findings)
    for finding in findings:
        print(f"{marks[finding.good]}  {finding.name:{width}}  {finding.told}")
    return int(any(finding.good is False for finding in findings))


if __name__ == "__main__":
    # the module that runs is called __main__: findings of plugins are those of the module they import
    from imagination.doctor import main as run

    sys.exit(run())
