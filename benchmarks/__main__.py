"""`make bench`, or `python -m benchmarks [section …]`: writes benchmarks/results.md and results.json.

Each section runs in a process of its own, so that its peak memory and its threads are its own.
"""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import tempfile
from dataclasses import asdict
from datetime import date
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

from benchmarks.measure import Figure, peak_memory

SECTIONS = ("startup", "rendering", "truth", "maps", "buffer", "training", "evaluation", "shards")
LIBRARIES = ("torch", "lightning", "numpy", "numba", "embreex", "opencv-python-headless", "timm")
FOLDER = Path(__file__).parent

HEAD = """# Benchmarks

Made by `{command}` on {day}: {hardware}; Python {python}, {libraries}; seed {seed}; {minutes:.1f} minutes.

Medians, in turns with what they are compared to. *Of the limit* says how near a figure is to what this machine could do
at best, measured in the same run: 100 % is there. *Times as fast* compares with another way to the same result,
re-implemented in vectorised torch on the same thread (`benchmarks/rivals.py`, equal outputs checked before timing).
"""


def main(sections: list[str]) -> None:
    """Run sections, write the results."""
    from benchmarks.subjects import SEED
    from imagination.evaluation.results import hardware

    start = perf_counter()
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for section in sections:
            print(f"{section} …", file=sys.stderr, flush=True)
            command = [sys.executable, "-m", "benchmarks", "--section", section, folder]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            results[section] = json.loads(done.stdout.splitlines()[-1])
    about = {
        "command": " ".join(["python -m benchmarks", *(sections if sections != list(SECTIONS) else [])]),
        "day": date.today().isoformat(),
        "hardware": hardware(),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in LIBRARIES},
        "seed": SEED,
        "minutes": (perf_counter() - start) / 60,
    }
    (FOLDER / "results.json").write_text(json.dumps({"about": about, "sections": results}, indent=1) + "\n")
    (FOLDER / "results.md").write_text(page(about, results))
    print((FOLDER / "results.md").read_text())


def page(about: dict[str, Any], results: dict[str, Any]) -> str:
    """The results as Markdown."""
    libraries = ", ".join(f"{name} {number}" for name, number in about["libraries"].items())
    parts = [HEAD.format(**{**about, "libraries": libraries})]
    for section, result in results.items():
        parts.append(f"## {section.capitalize()}\n\nPeak memory {result['peak_memory']:.1f} GB.\n")
        parts.append("| what | median | beside | ratio | target |\n|---|---|---|---|---|")
        parts += [row(Figure(**each)) for each in result["figures"]]
        notes = dict.fromkeys(
            f"- {each['what'].partition(':')[0]}: {each['note']}."
            for each in result["figures"]
            if each["note"]
        )
        parts += ["", *notes] if notes else [""]
        if result.get("operators"):
            parts.append("\nThe default unit's step by operator (share of the time, profiled):\n")
            parts += [f"- {share:.1%} `{name}`" for name, share in result["operators"]]
        parts.append("")
    return "\n".join(parts).rstrip() + "\n"


def row(figure: Figure) -> str:
    """One line of a table."""
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
    return f"| {figure.what} | {figure.value:.4g} {figure.unit} | {beside} | {ratio} | {target} |"


def section(name: str, folder: str) -> None:
    """Run one section and print it as one line of JSON."""
    module = import_module(f"benchmarks.{name}")
    figures = module.run(folder)
    print(
        json.dumps(
            {
                "figures": [asdict(figure) for figure in figures],
                "peak_memory": peak_memory(),
                "operators": getattr(module, "OPERATORS", None),
            }
        )
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--section"]:
        section(*sys.argv[2:4])
    else:
        wrong = [name for name in sys.argv[1:] if name not in SECTIONS]
        if wrong:
            sys.exit(f"benchmarks: got {' '.join(wrong)}, expected any of: {', '.join(SECTIONS)}")
        main(sys.argv[1:] or list(SECTIONS))
