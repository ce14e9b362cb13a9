"""`make bench`, or `python -m tests.benchmarks [section …]`: writes tests/benchmarks/results.md and results.json.

Each section runs in a process of its own, so that its peak memory and its threads are its own. Its results join those
that are there as soon as it ends; what cannot be measured on this machine is told in its place.
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

SECTIONS = tuple("startup rendering truth maps buffer training gpu distributed evaluation shards".split())
WITH_PROCESSES = {"startup", "rendering", "distributed", "shards"}
"""Sections that measure processes which they start."""

TITLES = {"gpu": "GPU"}
LIBRARIES = ("torch", "lightning", "numpy", "numba", "embreex", "opencv-python-headless", "timm")
FOLDER = Path(__file__).parent

HEAD = """# Benchmarks

Made {made}. The sections took {minutes:.1f} minutes together.

Medians, in turns with what they are compared to, unless a note says otherwise. *Of the limit* says how near a figure is
to what this machine could do at best, measured in the same run: 100 % is there. *Times as fast* compares with another
way to the same result: another setting, or a peer's way re-implemented in vectorised torch on the same thread
(`tests/benchmarks/rivals.py`, equal outputs checked before timing).
"""


def main(sections: list[str]) -> bool:
    """Run sections and write the results after each; whether all of them ended well."""
    command = " ".join(["python -m tests.benchmarks", *(sections if sections != list(SECTIONS) else [])])
    machine = inside("--machine")
    assert machine is not None
    well = True
    with tempfile.TemporaryDirectory() as folder:
        for section in sections:
            print(f"{section} …", file=sys.stderr, flush=True)
            start = perf_counter()
            result = inside("--section", section, folder)
            if result is None:
                well = False
                result = {"figures": [asdict(unmeasured(section, "it failed, the terminal says why"))]}
            result |= {"command": command, "minutes": (perf_counter() - start) / 60, **machine}
            write(FOLDER, section, result)
    print((FOLDER / "results.md").read_text())
    return well


def inside(*words: str) -> dict[str, Any] | None:
    """What a process of its own prints last, which keeps this one small; None if it fails."""
    command = [sys.executable, "-m", "tests.benchmarks", *words]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1])) if done.returncode == 0 else None


def write(folder: Path, section: str, result: dict[str, Any]) -> None:
    """Put a section's result in the place of its earlier one, beside those of the others."""
    path = folder / "results.json"
    sections = json.loads(path.read_text())["sections"] if path.is_file() else {}
    elsewhere = sections.get(section, result)["hardware"] != result["hardware"]
    if elsewhere and all(figure["value"] is None for figure in result["figures"]):
        print(f"{section}: not measured here, the figures of another machine stay", file=sys.stderr)
    else:
        sections[section] = result
    sections = {name: sections[name] for name in SECTIONS if name in sections}
    path.write_text(json.dumps({"sections": sections}, indent=1) + "\n")
    (folder / "results.md").write_text(page(sections))


def page(sections: dict[str, Any]) -> str:
    """The results as Markdown; what most sections were made with is told once, and by the others what they were."""
    made = [how_made(result) for result in sections.values()]
    count = Counter(each for how in made for each in how)
    common = [each for each in count if count[each] > len(made) / 2]
    minutes = sum(result["minutes"] for result in sections.values())
    unless = "" if all(how == made[0] for how in made) else ", unless a section says otherwise"
    parts = [HEAD.format(made=", ".join(common) + unless, minutes=minutes)]
    for how, (section, result) in zip(made, sections.items(), strict=True):
        about = [f"took {result['minutes']:.1f} minutes"]
        if "peak_memory" in result:
            about.append(f"peak memory {result['peak_memory']:.1f} GB")
        if result.get("peak_memory_of_processes"):
            about.append(f"{result['peak_memory_of_processes']:.1f} GB the largest process that it started")
        if own := [each for each in how if each not in common]:
            about.insert(0, f"made {', '.join(own)}")
        told = "; ".join(about)
        parts.append(f"## {TITLES.get(section, section.capitalize())}\n\n{told[0].upper()}{told[1:]}.\n")
        parts.append("| what | median | beside | ratio | target |\n|---|---|---|---|---|")
        parts += [row(Figure(**each)) for each in result["figures"]]
        parts += ["", *notes(result), ""]
    return "\n".join(parts).rstrip() + "\n"


def how_made(result: dict[str, Any]) -> list[str]:
    """Command, day, machine, versions and seed of a section."""
    libraries = ", ".join(f"{name} {number}" for name, number in result["libraries"].items())
    return [
        f"by `{result['command']}`",
        f"on {result['day']}",
        f"on {result['hardware']}",
        f"with Python {result['python']}, {libraries}",
        f"with seed {result['seed']}",
    ]


def notes(result: dict[str, Any]) -> list[str]:
    """What a reader has to know of a section's figures, each once."""
    of: dict[str, list[str]] = {}
    for figure in result["figures"]:
        if figure["note"]:
            of.setdefault(figure["note"], []).append(figure["what"])
    lines = []
    for note, (first, *others) in of.items():
        more = f" and {len(others)} like it" if others else ""
        lines.append(f"- {first}{more}: {note}.")
    for kind, operators in result.get("operators", {}).items():
        shares = ", ".join(f"{share:.0%} `{name}`" for name, share in operators)
        lines.append(f"- the default unit's step by operator, {kind}, profiled: {shares}.")
    return lines


def row(figure: Figure) -> str:
    """One line of a table."""
    median = "not measured" if figure.value is None else f"{figure.value:.4g} {figure.unit}"
    beside = f"{figure.limit:.4g} {figure.unit} ({figure.limit_is})" if figure.limit else ""
    ratio = ""
    if figure.ratio is not None:
        ratio = f"{figure.ratio:.3g} times as fast" if figure.rival else f"{figure.ratio:.0%} of the limit"
    target = ""
    if figure.target is not None:
        sign = "≤" if figure.at_most else "≥"
        wanted = (
            f"{figure.target:.0%} of the limit" if figure.of_limit else f"{figure.target:g} {figure.unit}"
        )
        target = f"{sign} {wanted}: {'met' if figure.met else '**missed**'}"
    return f"| {figure.what} | {median} | {beside} | {ratio} | {target} |"


def section(name: str, folder: str) -> None:
    """Run one section and print it as one line of JSON."""
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
    """Print what all sections of a run share as one line of JSON."""
    from imagination.utils.hardware import hardware
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
    wrong = [name for name in sys.argv[1:] if name not in SECTIONS]
    if sys.argv[1:] == ["--machine"]:
        machine()
    elif sys.argv[1:2] == ["--section"]:
        section(*sys.argv[2:4])
    elif wrong:
        sys.exit(f"benchmarks: got {' '.join(wrong)}, expected any of: {', '.join(SECTIONS)}")
    else:
        sys.exit(0 if main(sys.argv[1:] or list(SECTIONS)) else 1)
