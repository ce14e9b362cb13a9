"""A sweep's folder: its members, what was swept, and what came of it."""

import csv
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from imagination import members
from imagination.errors import UserError
from imagination.evaluation.metrics import CONFIDENCE, interval
from imagination.evaluation.outcome import Key
from imagination.evaluation.single_views import ranked_by
from imagination.evaluation.style import label
from imagination.reporting.content import Content, Drawing, Plain, Section, as_yaml, facts, trainings
from imagination.reporting.layout import Cell, Column, Layout, Line, bootstrap, cell_of, strengthened
from imagination.reporting.results import Results, Runs, read_csv
from imagination.reporting.score_figures import Point, draw_ablation
from imagination.runs import CONFIG

WHERE_AND_HOW = ("paths", "choices", "callbacks", "logger")
"""Nodes of a config that say where and how a member ran; they differ between members or follow from others."""


class Member(NamedTuple):
    """One run of a sweep.

    Attributes:
        number: name of its folder.
        results: what its folder holds; None if there is nothing to read.
        state: complete, incomplete, failed, unfinished or missing.
        reason: in a line, unless it is complete.
        asked: its overrides that were swept, where they are known.
    """

    number: str
    results: Results | None
    state: str
    reason: str
    asked: dict[str, str]


class Multirun:
    """A sweep's folder.

    Args:
        folder: with a numbered folder for each member.

    Raises:
        UserError: if none of them can be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        listed = list_of(folder / members.FILE)
        asked = [asked for asked, _, _ in listed] or grid(folder / "multirun.yaml")
        there = [path.name for path in folder.iterdir() if path.is_dir() and path.name.isdigit()]
        last = max([len(asked) - 1, *map(int, there)])
        self.members = [
            member(
                folder / str(number),
                asked[number] if number < len(asked) else {},
                listed[number][1:] if number < len(listed) else ("", ""),
            )
            for number in range(last + 1)
        ]
        if not self.read:
            raise UserError(
                f"report: none of the {len(self.members)} members of {folder} has a config to read"
            )

    @property
    def read(self) -> list[Member]:
        """Members whose config can be read."""
        return [member for member in self.members if member.results is not None]

    @cached_property
    def swept(self) -> dict[str, dict[str, str]]:
        """The value of everything that was swept, by key and number of the member."""
        configs = {member.number: member.results.config for member in self.read if member.results}
        by_choice = {number: _choices(config) for number, config in configs.items()}
        if found := _differing(by_choice):
            return found
        by_key = {number: dict(_flat(config)) for number, config in configs.items()}
        return _independent(_differing(by_key))

    def values(self, member: Member) -> dict[str, str]:
        """What was swept of one member; of one that left no config, as its sweep asked for it."""
        return {key: of.get(member.number, member.asked.get(key, "?")) for key, of in self.swept.items()}


def is_multirun(folder: Path) -> bool:
    """Whether a folder is a sweep's: it has numbered folders, and no config of its own."""
    return any(path.is_dir() and path.name.isdigit() for path in folder.iterdir())


def grid(path: Path) -> list[dict[str, str]]:
    """The overrides of every member that a sweep's multirun.yaml asks for, in the order of their numbers.

    Empty where there is no such file or its sweeper is not Hydra's own, whose members are known beforehand.
    """
    try:
        asked = yaml.safe_load(path.read_text())["hydra"]
        if not asked["sweeper"]["_target_"].endswith("BasicSweeper"):
            return []
        texts = [*(f"{key}={value}" for key, value in (asked["sweeper"]["params"] or {}).items())]
        texts += asked["overrides"]["task"]
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError):
        return []
    parsed = [each for each in OverridesParser.create().parse_overrides(texts) if each.is_sweep_override()]
    lists = [[(each.key_or_group, text) for text in each.sweep_string_iterator()] for each in parsed]
    return [dict(choice) for choice in product(*lists)]


def list_of(path: Path) -> list[tuple[dict[str, str], str, str]]:
    """Overrides, state and problem of each member, in the order of their folders, as a sweep's members.csv has them.

    Empty where there is no such file.

    Raises:
        UserError: if it is damaged.
    """
    if not path.is_file():
        return []
    try:
        rows = sorted(read_csv(path), key=lambda row: int(row["folder"]))
        told = [(_overrides(shlex.split(row["overrides"])), row["state"], row["problem"]) for row in rows]
    except (ValueError, KeyError, csv.Error) as error:
        raise UserError(
            f"sweep {path}: is damaged ({error}); delete it to go by the folders alone"
        ) from error
    every = {str(number): values for number, (values, _, _) in enumerate(told)}
    kept = _differing(every)
    return [
        ({key: of[str(number)] for key, of in kept.items()}, state, problem)
        for number, (_, state, problem) in enumerate(told)
    ]


def member(folder: Path, asked: dict[str, str], told: tuple[str, ...] = ("", "")) -> Member:
    """One member, and how far it came; `told` is its state and problem as the sweep itself has them."""
    state, problem = told
    if state == "failed":
        results = Results(folder) if (folder / CONFIG).is_file() else None
        return Member(folder.name, results, "failed", problem, asked)
    if not folder.is_dir():
        return Member(
            folder.name, None, "missing", "has no folder: it was never started, or was deleted", asked
        )
    try:
        results = Results(folder)
    except UserError as error:
        return Member(folder.name, None, "failed", str(error).partition(";")[0], asked)
    if results.counts and not results.problems:
        return Member(folder.name, results, "complete", "", asked)
    if results.counts:
        return Member(folder.name, results, "incomplete", "; ".join(results.problems), asked)
    log = folder / "run.log"
    text = log.read_text(errors="replace") if log.is_file() else ""
    if "The run failed" in text:
        return Member(folder.name, results, "failed", text.strip().splitlines()[-1], asked)
    return Member(folder.name, results, "unfinished", "left no results: it still runs, or was stopped", asked)


def of_multirun(sweep: Multirun) -> Content:
    """Everything that a sweep has to tell."""
    measured = [member for member in sweep.read if member.results and member.results.counts]
    first = _results([*measured, *sweep.read][0])
    problems = [
        f"member {member.number} ({_told(sweep.values(member))}) is {member.state}: {member.reason}"
        for member in sweep.members
        if member.state != "complete"
    ]
    keys = ", ".join(sweep.swept) or "nothing"
    done = sum(member.state == "complete" for member in sweep.members)
    told = [("Swept", keys), ("Members", f"{len(sweep.members)}, {done} complete"), *facts(first)[1:]]
    sections = [Section("Members", plain=(Plain("What was swept, and what came of it", _rows(sweep)),))]
    if measured and sweep.swept:
        sections.append(Section(
            "Ablation",
            f"Pooled IoU with {CONFIDENCE:.0%} intervals over homes.",
            layouts=tuple(_layouts(sweep, measured)),
            drawings=tuple(_drawings(sweep, measured)),
        ))  # fmt: skip
    title = f"Sweep of {first.name}"
    return Content(
        title,
        [("Folder", str(sweep.folder)), *told],
        problems,
        sections,
        _commands(sweep, first),
        as_yaml(first),
    )


def _rows(sweep: Multirun) -> list[dict[str, str]]:
    return [
        {"member": each.number, **sweep.values(each), "state": each.state, "reason": each.reason}
        for each in sweep.members
    ]


def _layouts(sweep: Multirun, measured: Sequence[Member]) -> Iterator[Layout]:
    """One table, a block for each approach and a line for each member."""
    every = [key for each in measured for key in _results(each).counts]
    widths = sorted({key.cell_width for key in every}, reverse=True)
    categories = list(dict.fromkeys(key.category for key in every))
    columns = [Column(width, category) for width in widths for category in categories]
    blocks = []
    for approach in dict.fromkeys(key.approach for key in every):
        lines = [
            Line(
                _told(sweep.values(each)),
                [cell_of(_results(each), Key(approach, at.category, at.cell_width), "iou") for at in columns],
            )
            for each in measured
        ]
        blocks.append((label(approach), strengthened([each.number for each in measured], lines)))
    note = "Pooled over runs, with intervals over homes; the best of each block and column is bold."
    yield Layout("ablation", "IoU of the global map by what was swept", note, columns, blocks, ".3f")


def _drawings(sweep: Multirun, measured: Sequence[Member]) -> Iterator[Drawing]:
    """A figure for each category and each key that was swept.

    Lines are approaches where one key was swept, else what else was swept, for the approach that ranks.
    """
    categories = dict.fromkeys(key.category for each in measured for key in _results(each).counts)
    approaches = list(dict.fromkeys(key.approach for each in measured for key in _results(each).counts))
    for key, category in product(sweep.swept, categories):
        several = len(sweep.swept) > 1
        shown = [ranked_by(approaches)] if several else approaches
        panels = {
            title: lines
            for title, width in _panels(measured).items()
            if (lines := _lines(sweep, measured, key, category, shown, width))
        }
        if not panels:
            continue  # no member has both the category and the approach
        what = f" ({label(shown[0])})" if several else ""
        stem = "".join(letter if letter.isalnum() else "_" for letter in key)
        yield Drawing(
            f"ablation_{stem}_{category}",
            f"{category}{what}: pooled IoU over {key}.",
            partial(draw_ablation, panels, key, "pooled IoU"),
            wide=len(panels) > 1,
        )


def _panels(measured: Sequence[Member]) -> dict[str, float | None]:
    """Cell widths that all members have; where they have none in common, all widths of each together."""
    sets = [{key.cell_width for key in _results(each).counts} for each in measured]
    common = sorted(set.intersection(*sets), reverse=True)
    return {f"cell width {width:g} m": width for width in common} or {"all cell widths together": None}


def _lines(
    sweep: Multirun,
    measured: Sequence[Member],
    key: str,
    category: str,
    approaches: Sequence[str],
    width: float | None,
) -> dict[str, list[Point]]:
    lines: dict[str, list[Point]] = {}
    for each, approach in product(measured, approaches):
        values = sweep.values(each)
        rest = _told({other: value for other, value in values.items() if other != key})
        if (cell := _cell(_results(each), approach, category, width)) is not None:
            lines.setdefault(rest or approach, []).append((values[key], cell.value, cell.low, cell.high))
    return lines


def _cell(results: Results, approach: str, category: str, width: float | None) -> Cell | None:
    if width is not None:
        return cell_of(results, Key(approach, category, width), "iou")
    runs: Runs = {
        (home, number + 1000 * place): pixels
        for place, at in enumerate(results.cell_widths)
        for (home, number), pixels in results.counts.get(Key(approach, category, at), {}).items()
    }
    if not runs:
        return None
    samples, value = bootstrap(results, runs, "iou")
    return Cell(value, *interval(samples))


def _results(each: Member) -> Results:
    assert each.results is not None
    return each.results


def _commands(sweep: Multirun, first: Results) -> list[str]:
    """What an evaluation's networks were trained with, the sweep as its multirun.yaml has it, and the report."""
    report = shlex.join(["python", "-m", "imagination.report", str(sweep.folder)])
    try:
        asked = yaml.safe_load((sweep.folder / "multirun.yaml").read_text())["hydra"]
        given = [text for text in asked["overrides"]["task"] if not text.startswith("sweep_dir=")]
        swept = shlex.join(["python", "-m", f"imagination.{asked['job']['name']}", "-m", *given])
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError):
        return [report]  # a search leaves no such file
    return [*(trainings(first) if "ckpt" in first.config else []), swept, report]


def _told(values: Mapping[str, str]) -> str:
    return ", ".join(f"{key}={value}" for key, value in values.items())


def _choices(config: Mapping[str, Any]) -> dict[str, str]:
    """A member's own overrides, by key."""
    return _overrides([str(text) for text in config.get("choices") or []])


def _overrides(texts: Sequence[str]) -> dict[str, str]:
    parts = [text.lstrip("+~").partition("=") for text in texts]
    return {key: value for key, _, value in parts}


def _differing(by_number: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, str]]:
    """Keys whose value differs between members."""
    keys = dict.fromkeys(key for values in by_number.values() for key in values)
    found = {key: {number: values.get(key, "–") for number, values in by_number.items()} for key in keys}
    return {key: of for key, of in found.items() if len(set(of.values())) > 1}


def _independent(found: Mapping[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """Of keys that tell the members apart in the same way, as references do, the one highest in the config."""
    kept: dict[tuple[int, ...], str] = {}
    for key in sorted(found, key=lambda key: (key.count("."), len(key))):
        values = list(found[key].values())
        kept.setdefault(tuple(values.index(value) for value in values), key)
    return {key: found[key] for key in kept.values()}


def _flat(node: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Values of a config by dotted key; classes by their name alone."""
    for key, value in node.items():
        if not prefix and key in WHERE_AND_HOW:
            continue
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        elif key == "_target_":
            yield prefix.removesuffix("."), str(value).rpartition(".")[2]
        else:
            yield f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value)
