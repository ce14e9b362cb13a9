"""Benchmarks: `make bench`, or `python -m tests.benchmarks [section …]`; writes results.md and results.json.

Each section runs in a separate process, so that its peak memory and its threads are measured alone. Its results replace
its earlier ones as soon as it ends; figures that this machine cannot measure are marked.
"""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import asdict
from datetime import date
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from resource import RUSAGE_CHILDREN
from time import perf_counter
from typing import Any

from tests.benchmarks.measure import Figure, peak_memory, unmeasured

SECTIONS = tuple(
    "startup rendering ground_truth maps buffer training gpu distributed evaluation shards".split()
)
WITH_PROCESSES = {"startup", "rendering", "distributed", "shards"}
"""Sections that start processes and measure them."""

TITLES = {"gpu": "GPU", "ground_truth": "Ground truth"}
LIBRARIES = ("torch", "lightning", "numpy", "numba", "embreex", "opencv-python-headless", "timm")
FOLDER = Path(__file__).parent

HEAD = """# Benchmarks

Made {made}. The sections took {minutes:.1f} minutes together.

Medians, measured alternately with their references unless a note states otherwise. *Of the limit* relates a figure to
the best that this machine can do, measured in the same run. *Times as fast* compares with another method for the same
result: another setting, or the method of a public system re-implemented in vectorised torch on the same thread
(`tests/benchmarks/rivals.py`; its outputs are compared before timing).
"""


def main(sections: list[str]) -> bool:
    """Run sections, write the results after each, and return whether all succeeded."""
    command = " ".join(["python -m tests.benchmarks", *(sections if sections != list(SECTIONS) else [])])
    machine = run_in_process("--machine")
    assert machine is not None
    success = True
    with tempfile.TemporaryDirectory() as folder:
        for section in sections:
            print(f"{section} …", file=sys.stderr, flush=True)
            start = perf_counter()
            result = run_in_process("--section", section, folder)
            if result is None:
                success = False
                result = {"figures": [asdict(unmeasured(section, "the section failed; see the terminal"))]}
            result |= {"command": command, "minutes": (perf_counter() - start) / 60, **machine}
            write(FOLDER, section, result)
    print((FOLDER / "results.md").read_text())
    return success


def run_in_process(*arguments: str) -> dict[str, Any] | None:
    """Run this module in a new process, which keeps this one small; return its last line, or None if it fails."""
    command = [sys.executable, "-m", "tests.benchmarks", *arguments]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1])) if done.returncode == 0 else None


def write(folder: Path, section: str, result: dict[str, Any]) -> None:
    """Replace the result of a section in results.json, and write results.md."""
    path = folder / "results.json"
    sections = json.loads(path.read_text())["sections"] if path.is_file() else {}
    other_machine = sections.get(section, result)["hardware"] != result["hardware"]
    if other_machine and all(figure["value"] is None for figure in result["figures"]):
        print(
            f"{section}: not measured on this machine; the figures of another machine are kept",
            file=sys.stderr,
        )
    else:
        sections[section] = result
    sections = {name: sections[name] for name in SECTIONS if name in sections}
    path.write_text(json.dumps({"sections": sections}, indent=1) + "\n")
    (folder / "results.md").write_text(page(sections))


def page(sections: dict[str, Any]) -> str:
    """Return the results as Markdown; the head has the provenance common to most sections."""
    provenances = [provenance(result) for result in sections.values()]
    count = Counter(value for values in provenances for value in values)
    common = [value for value in count if count[value] > len(provenances) / 2]
    minutes = sum(result["minutes"] for result in sections.values())
    uniform = all(values == provenances[0] for values in provenances)
    exceptions = "" if uniform else ", unless a section states otherwise"
    parts = [HEAD.format(made=", ".join(common) + exceptions, minutes=minutes)]
    for values, (section, result) in zip(provenances, sections.items(), strict=True):
        about = [f"took {result['minutes']:.1f} minutes"]
        if "peak_memory" in result:
            about.append(f"peak memory {result['peak_memory']:.1f} GB")
        if result.get("peak_memory_of_processes"):
            about.append(f"{result['peak_memory_of_processes']:.1f} GB in its largest child process")
        if different := [value for value in values if value not in common]:
            about.insert(0, f"made {', '.join(different)}")
        sentence = "; ".join(about)
        title = TITLES.get(section, section.capitalize())
        parts.append(f"## {title}\n\n{sentence[0].upper()}{sentence[1:]}.\n")
        parts.append("| measurement | median | reference | ratio | target |\n|---|---|---|---|---|")
        parts += [row(Figure(**figure)) for figure in result["figures"]]
        parts += ["", *notes(result), ""]
    return "\n".join(parts).rstrip() + "\n"


def provenance(result: dict[str, Any]) -> list[str]:
    """Return the command, day, machine, versions and seed of a section."""
    libraries = ", ".join(f"{name} {number}" for name, number in result["libraries"].items())
    return [
        f"by `{result['command']}`",
        f"on {result['day']}",
        f"on {result['hardware']}",
        f"with Python {result['python']}, {libraries}",
        f"with seed {result['seed']}",
    ]


def notes(result: dict[str, Any]) -> list[str]:
    """Return the notes on the figures of a section, without duplicates."""
    figures_of: dict[str, list[str]] = {}
    for figure in result["figures"]:
        if figure["note"]:
            figures_of.setdefault(figure["note"], []).append(figure["what"])
    lines = []
    for note, (first, *others) in figures_of.items():
        more = f" and {len(others)} like it" if others else ""
        lines.append(f"- {first}{more}: {note}.")
    for kind, operators in result.get("operators", {}).items():
        fractions = ", ".join(f"{fraction:.0%} `{name}`" for name, fraction in operators)
        lines.append(f"- the default unit's step by operator, {kind}, profiled: {fractions}.")
    return lines


def row(figure: Figure) -> str:
    """Return a figure as a row of the table."""
    median = "not measured" if figure.value is None else f"{figure.value:.4g} {figure.unit}"
    reference = f"{figure.limit:.4g} {figure.unit} ({figure.limit_is})" if figure.limit else ""
    ratio = ""
    if figure.ratio is not None:
        ratio = f"{figure.ratio:.3g} times as fast" if figure.rival else f"{figure.ratio:.0%} of the limit"
    target = ""
    if figure.target is not None:
        sign = "≤" if figure.at_most else "≥"
        value = f"{figure.target:.0%} of the limit" if figure.of_limit else f"{figure.target:g} {figure.unit}"
        target = f"{sign} {value}: {'met' if figure.met else '**missed**'}"
    return f"| {figure.what} | {median} | {reference} | {ratio} | {target} |"


def section(name: str, folder: str) -> None:
    """Run one section and print its result as one line of JSON."""
    from imagination.utils.errors import UserError

    module = import_module(f"tests.benchmarks.{name}")
    try:
        figures = module.run(folder)
    except UserError as error:  # an optional package is not installed
        figures = [unmeasured(name, str(error))]
    result = {
        "figures": [asdict(figure) for figure in figures],
        "operators": getattr(module, "OPERATORS", {}),
        "peak_memory": peak_memory(),
    }
    if name in WITH_PROCESSES:
        result["peak_memory_of_processes"] = peak_memory(RUSAGE_CHILDREN)
    print(json.dumps(result))


def machine() -> None:
    """Print the provenance common to all sections as one line of JSON."""
    from imagination.utils.provenance import hardware
    from tests.benchmarks.subjects import SEED

    about = {
        "day": date.today().isoformat(),
        "hardware": hardware(),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in LIBRARIES},
        "seed": SEED,
    }
    print(json.dumps(about))


if __name__ == "__main__":
    unknown = [name for name in sys.argv[1:] if name not in SECTIONS]
    if sys.argv[1:] == ["--machine"]:
        machine()
    elif sys.argv[1:2] == ["--section"]:
        section(*sys.argv[2:4])
    elif unknown:
        sys.exit(f"benchmarks: got {' '.join(unknown)}, expected any of: {', '.join(SECTIONS)}")
    else:
        sys.exit(0 if main(sys.argv[1:] or list(SECTIONS)) else 1)
