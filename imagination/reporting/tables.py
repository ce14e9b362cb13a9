"""Tables of the mapping task as data frames, and their text for files and the terminal."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from imagination.evaluation.approaches import REFERENCE
from imagination.evaluation.metrics import iou
from imagination.evaluation.record_files import PIXELS
from imagination.reporting.statistics import (
    KEY,
    Bootstrap,
    Difference,
    counts_of,
    difference,
    estimate,
    groups,
    of_all_seeds,
    select,
)
from imagination.utils.tabular import Row

MAPPING = (
    *("approach", "category", "cell_width", "trials", "seeds", "iou_pooled", "iou_mean", "iou_ci_low", "iou_ci_high"),
    *("iou_seed_std", *PIXELS),
)  # fmt: skip
"""Columns of mapping.csv, which other programs read."""

MAPPING_SEEDS = ("approach", "category", "cell_width", "seed", "trials", "iou_pooled", "iou_mean", *PIXELS)
"""Columns of mapping_seeds.csv."""

SCREEN_MAPPING = (
    *("approach", "category", "cell_width", "iou_pooled", "iou_ci_low", "iou_ci_high", "iou_seed_std", *PIXELS),
)  # fmt: skip
"""Columns of the results table in the terminal."""

SCREEN_SWEEP = (
    *("category", "cell_width", "iou_pooled", "iou_ci_low", "iou_ci_high", "iou_seed_std", "correct_pixels"),
)  # fmt: skip
"""Columns of the table of a sweep in the terminal, after the swept keys."""

SCREEN_PAIRED = (
    *("difference", "category", "cell_width", "iou_pooled", "ci_low", "ci_high", "iou_seed_std", "correct_pixels"),
)  # fmt: skip
"""Columns of the table of paired differences in the terminal."""


def mapping(trials: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """Return one row for each approach, category and cell width; counts are means over seeds."""
    rows = []
    for key, all_trials in groups(trials):
        group = of_all_seeds(all_trials)
        counts = counts_of(group)
        value, low, high, seed_std = estimate(counts, bootstrap)
        each = iou(group[list(PIXELS)].to_numpy())
        seeds = all_trials["seed"].nunique()
        pixels = [_whole(total / seeds) for total in counts.sum(axis=(0, 1)).tolist()]
        mean = float(each.mean()) if len(each) else math.nan
        rows.append((*key, len(group) // seeds, seeds, value, mean, low, high, seed_std, *pixels))
    return pd.DataFrame(rows, columns=list(MAPPING))


def mapping_seeds(trials: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each approach, category, cell width and training seed."""
    rows = []
    for key, group in groups(trials):
        for seed, part in group.groupby("seed"):
            counts = part[list(PIXELS)].to_numpy()
            total = counts.sum(axis=0)
            rows.append((*key, seed, len(part), float(iou(total)), iou(counts).mean(), *total.tolist()))
    return pd.DataFrame(rows, columns=list(MAPPING_SEEDS))


def details(trials: pd.DataFrame, about: Mapping[str, Any]) -> pd.DataFrame:
    """Return the selected threshold and kernel, the area and the IoU by cells and order of each row of the results.

    Args:
        trials: trials of one training seed.
        about: content of evaluation.json; see `record_files`.
    """
    selected = {(each["approach"], each["category"]): each for each in about["selected"]}
    rows = []
    for key, group in groups(trials):
        total, shuffled, seen = (
            counts_of(group, suffix).sum(axis=(0, 1)) for suffix in ("", "_shuffled", "_seen")
        )
        chosen = selected.get(key[:2], {})
        rows.append(
            {
                **dict(zip(KEY, key, strict=True)),
                "seed": about["seed"],
                "scenes": group["scene"].nunique(),
                "scenes_left_out": about["left_out"].get(key[1], 0),
                "resolution": about["resolution"],
                "area_m2": float(total[0]) * about["resolution"] ** 2,
                "threshold": chosen.get("threshold", math.nan),
                "kernel_m": chosen.get("kernel", math.nan),
                "iou_val": chosen.get("iou", math.nan),
                "iou_shuffled": float(iou(shuffled)),
                "iou_seen": float(iou(seen)),
                "iou_unseen": float(iou(total - seen)),
            }
        )
    return pd.DataFrame(rows)


def pairs(approaches: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of approaches that are compared: `REFERENCE` with each other one."""
    return [(REFERENCE, name) for name in approaches if name != REFERENCE and REFERENCE in approaches]


def paired(trials: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """Return paired differences of pooled IoU between approaches, with intervals over scenes."""
    rows = []
    names = list(trials["approach"].unique())
    places = trials[["category", "cell_width"]].drop_duplicates().itertuples(index=False)
    by_second = [(first, second, *place) for place in places for first, second in pairs(names)]
    for first, second, category, width in sorted(by_second, key=lambda row: names.index(row[1])):
        ours, theirs = (select(trials, name, category, width) for name in (first, second))
        if (found := difference(ours, theirs, bootstrap, "iou")) is None:
            continue
        pixels = difference(ours, theirs, bootstrap, "correct_pixels")
        assert pixels is not None  # of the same trials
        rows.append(
            {
                "category": category,
                "cell_width": width,
                "difference": f"{first} - {second}",
                **difference_columns(found),
                "correct_pixels": _whole(pixels.estimate.value),
                "scenes": found.scenes,
            }
        )
    return pd.DataFrame(rows)


def difference_columns(found: Difference) -> dict[str, float]:
    """Return the columns of a paired difference of IoU."""
    names = ("iou_pooled", "ci_low", "ci_high", "iou_seed_std")
    return dict(zip(names, found.estimate, strict=True))


def furniture(unseen: pd.DataFrame, known: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """Return pooled IoU with intervals in scenes with training furniture (not trained on) and in test scenes."""
    rows = []
    for key, group in groups(known):
        row = dict(zip(KEY, key, strict=True))
        for name, part in (("known", group), ("unseen", select(unseen, *key))):
            value, low, high, _ = estimate(counts_of(part), bootstrap)
            row |= {f"iou_{name}": value, f"ci_low_{name}": low, f"ci_high_{name}": high}
            row |= {f"scenes_{name}": part["scene"].nunique()}
        rows.append(row)
    return pd.DataFrame(rows)


def networks(rows: Iterable[Row], first_person: Mapping[str, float]) -> list[Row]:
    """Return the rows on the training of the networks, with the IoU of predicted images by category."""
    return [
        {
            **{name: value for name, value in row.items() if name != "kind"},
            "iou_first_person": (
                f"{first_person[row['category']]:.4f}"
                if row["kind"] == "images" and row["category"] in first_person
                else ""
            ),
        }
        for row in rows
    ]


FORMATS = {
    "cell_width": "g",
    "kernel_m": "g",
    "resolution": "g",
    "threshold": ".2f",
    **dict.fromkeys(PIXELS, ".1f"),
}
"""Formats of numbers with a fraction by column; four decimals if it is not listed."""

SIGNED = {**dict.fromkeys(("iou_pooled", "ci_low", "ci_high"), "+.4f"), "correct_pixels": "+.1f"}
"""Formats of differences by column."""


def text(frame: pd.DataFrame, formats: Mapping[str, str] = FORMATS) -> list[Row]:
    """Return the rows of a table as text; equal numbers give equal text, NaN is empty."""
    columns = [(name, formats.get(name, FORMATS.get(name, ".4f"))) for name in frame.columns]
    return [
        {name: _text(value, form) for (name, form), value in zip(columns, row, strict=True)}
        for row in frame.itertuples(index=False)
    ]


def _text(value: Any, form: str) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else format(value, form)
    return format(value, "+d" if form.startswith("+") else "d") if isinstance(value, int) else str(value)


def _whole(value: float) -> int | float:
    """Return a number without its fraction if it has none."""
    return int(value) if value == round(value) else value


def to_screen(rows: Sequence[Row], title: str, columns: Sequence[str]) -> Table:
    """Return some columns of a table, as far as they have values, as a narrow table for the terminal."""
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    shown = [column for column in columns if any(row[column] for row in rows)]
    for column in shown:
        left = column in ("approach", "category", "difference")
        wrap = column == "difference"  # contains two long names
        heading = re.sub(r"_|(?<=\.)", "\n", column)
        table.add_column(Text(heading), justify="left" if left else "right", no_wrap=not wrap)
    for row in rows:
        table.add_row(*(Text(row[column]) for column in shown))  # Text shows brackets as they are
    return table
