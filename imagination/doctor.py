"""Check the requirements of the program on this machine: `python -m imagination.doctor`."""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from omegaconf import DictConfig

from imagination.config.plugin_registry import discover, provided
from imagination.runs.command import command
from imagination.utils.diagnostics import Finding

GROUP = "doctor"
"""Config group in which plugins register checks: the `_target_` of each file is a function that yields findings."""

MEMORY, DISK = 8.0, 5.0
"""Memory and disk space for the default job, GB."""


def check_machine() -> Iterator[Finding]:
    """Check Python, packages, GPU, cores, memory and disk."""
    good = sys.version_info >= (3, 11)
    yield Finding("python", good, f"{sys.version.split()[0]}{'' if good else ', expected 3.11 or later'}")
    for package in ("torch", "lightning", "embreex", "numba", "opencv-python-headless"):
        yield _package(package)
    yield _gpu()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    yield Finding("cores", cores >= 2, f"{cores}{'' if cores >= 2 else '; the default job uses 2'}")
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    yield Finding("memory", memory >= MEMORY, f"{memory:.0f} GB (the default job needs about 5)")
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    yield Finding(
        "disk",
        free >= DISK,
        f"{free:.0f} GB free in {Path.cwd()} (for outputs; change it with paths.outputs)",
    )


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, version(name))
    except PackageNotFoundError:
        return Finding(name, False, "not installed; run `make setup`")


def _gpu() -> Finding:
    try:
        import torch
    except ImportError as error:
        return Finding("GPU", False, f"torch cannot be imported: {error}")
    if torch.cuda.is_available():
        return Finding("GPU", True, torch.cuda.get_device_name(0))
    return Finding("GPU", None, "no CUDA GPU; everything runs on the CPU")


def check_plugins() -> Iterator[Finding]:
    """Check that the plugins are valid, and run the checks that they register."""
    for plugin in discover():
        yield Finding(f"plugin {plugin.name}", not plugin.problem, plugin.problem or plugin.origin)
    for plugin_name, _, target in provided(GROUP):
        yield from _run_check(plugin_name, target)


def _run_check(plugin: str, target: str) -> Iterator[Finding]:
    from hydra.utils import get_method

    try:
        function: Callable[[], Iterator[Finding]] = get_method(target)
        yield from function()
    except Exception as error:  # code of a plugin may raise any type of exception
        yield Finding(f"plugin {plugin}", False, f"{target}: {type(error).__name__}: {error}")


@command("doctor", lambda config: None)
def main(config: DictConfig) -> None:
    """Print all findings; exit with code 1 if a requirement is not met."""
    findings = [*check_machine(), *check_plugins()]
    marks = {True: "ok", None: "--", False: "!!"}
    width = max(len(finding.name) for finding in findings)
    for finding in findings:
        print(f"{marks[finding.good]}  {finding.name:{width}}  {finding.message}")
    sys.exit(any(finding.good is False for finding in findings))


if __name__ == "__main__":
    main()
