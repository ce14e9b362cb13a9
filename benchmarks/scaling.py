"""`python -m benchmarks.scaling`: what the measured costs predict for many machines, into docs/scaling.md.

Reads benchmarks/results.json. Machines are like the one measured; they share one storage.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
PAGE = FOLDER.parent / "docs" / "scaling.md"
BEGIN, END = "<!-- made by python -m benchmarks.scaling -->", "<!-- end -->"

HOMES, VIEWS = 1000, 10_000_000
STORAGE = 125e6
"""Bytes a second that all machines together write to or read from the storage: 1 Gbit/s, an assumption."""


def value(results: dict[str, Any], section: str, starts: str) -> float:
    """The median of the figure whose name starts so."""
    for figure in results["sections"][section]["figures"]:
        if figure["what"].startswith(starts):
            return float(figure["value"])
    raise KeyError(f"{section}: no figure starts with {starts!r}; run make bench")


def predicted(results: dict[str, Any]) -> str:
    """Costs and predictions as Markdown."""
    truth = value(results, "shards", "home and truth for a corpus")
    one, two = (value(results, "shards", f"views written by {n}") for n in (1, 2))
    size, read = 1e3 * value(results, "shards", "size of a view"), value(results, "shards", "views read")
    steps = [f["what"] for f in results["sections"]["training"]["figures"] if "(default)" in f["what"]]
    samples = max(float(what.rpartition(": ")[2].split()[0]) for what in steps)
    efficiency = two / (2 * one)
    lines = [
        "| unit cost | measured |",
        "|---|---|",
        f"| a home and its ground truth | {truth:.1f} s a core |",
        f"| a view: rendered, projected, cropped, written | {1e3 / one:.1f} ms a core |",
        f"| two processes over twice one | {efficiency:.0%} |",
        f"| size of a view | {size / 1e3:.1f} kB |",
        f"| reading shards | {read:.0f} views/s a process |",
        f"| training, default unit, desk scale | {samples:.0f} samples/s a machine |",
        "",
        f"{HOMES:,} homes and {VIEWS:,} views ({VIEWS * size / 1e12:.2f} TB) on machines of 2 cores:",
        "",
        "| machines | rendering | written | training on each view once | read |",
        "|---|---|---|---|---|",
    ]
    for machines in (1, 10, 100):
        # the truth of a home is paid once, whatever the number of its views
        work = HOMES * truth + VIEWS / one
        hours = max(work / (2 * efficiency * machines), VIEWS * size / STORAGE) / 3600
        epoch = max(VIEWS / (samples * machines), VIEWS * size / STORAGE) / 3600
        written, fetched = (VIEWS * size / (3600 * each) / 1e6 for each in (hours, epoch))
        lines.append(
            f"| {machines} | {hours:.1f} h | {written:.0f} MB/s | {epoch:.1f} h | {fetched:.0f} MB/s |"
        )
    writers, readers = STORAGE / (2 * efficiency * one * size), STORAGE / (samples * size)
    lines += [
        "",
        f"A storage of {STORAGE / 1e6:.0f} MB/s saturates first: in rendering at {writers:.0f} machines, in",
        f"training at {readers:.0f}. One process reads {read / samples:.0f} times what a machine's training asks for.",
    ]
    return "\n".join(lines)


def main() -> None:
    """Write the predictions between the marks of the page."""
    page = PAGE.read_text()
    before, rest = page.split(BEGIN)
    text = predicted(json.loads((FOLDER / "results.json").read_text()))
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main()
