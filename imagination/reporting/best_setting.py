"""Comparison of a sweep's settings: which have the same ground truth, and the best one on validation scenes."""

from functools import partial

import pandas as pd

from imagination.evaluation.record_files import PIXELS
from imagination.evaluation.single_views import ranked_by
from imagination.reporting import tables
from imagination.reporting.load_sweep import Multirun, Setting, results_of
from imagination.reporting.paper_layout import Column
from imagination.reporting.statistics import MIN_SCENES
from imagination.reporting.style import label


def best_setting(sweep: Multirun) -> tuple[Setting, float] | None:
    """Return the setting with the highest IoU on validation scenes and that IoU, the mean over categories.

    The score is that of the ranking approach. None if a setting has no score, or other categories, cell widths or
    ground truth than the others, or all scores are equal.
    """
    if not sweep.settings:
        return None
    approach = ranked_by(sweep.approaches)
    columns = [set(setting.trials.groupby(["category", "cell_width"]).groups) for setting in sweep.settings]
    if any(each != columns[0] for each in columns) or not all(map(partial(comparable, sweep), sweep.columns)):
        return None
    scored = []
    for setting in sweep.settings:
        scores = [setting.validated(approach, category) for category in setting.trials["category"].unique()]
        if None in scores:
            return None
        scored.append((setting, sum(score for score in scores if score is not None) / len(scores)))
    several = len({score for _, score in scored}) > 1
    return max(scored, key=lambda pair: pair[1]) if several else None


def summary(sweep: Multirun) -> list[str]:
    """Return lines on the best setting of a sweep with its uncertainty in test scenes."""
    if len(sweep.settings) < 2:
        return []
    if (found := best_setting(sweep)) is None:
        return ["No best setting: the scores on validation scenes are equal, missing or not comparable"]
    setting, score = found
    approach = ranked_by(sweep.approaches)
    lines = [f"Best setting on validation scenes ({label(approach)}, IoU {score:.4f}): {setting.name}"]
    for row in tables.text(tables.mapping(setting.trials, results_of(setting.jobs[0]).bootstrap)):
        if row["approach"] == approach:
            std = f" ± {row['iou_seed_std']} over {row['seeds']} seeds" if row["iou_seed_std"] else ""
            span = f" [{row['iou_ci_low']}, {row['iou_ci_high']}] over scenes" if row["iou_ci_low"] else ""
            lines.append(
                f"  {row['category']}, cell width {row['cell_width']} m: test IoU {row['iou_pooled']}{std}{span}"
            )
    return lines


def enough_scenes(sweep: Multirun, at: Column) -> bool:
    """Return whether the category of a column is in enough scenes of every setting to name a best one."""
    scenes = [
        setting.trials[setting.trials["category"] == at.category]["scene"].nunique()
        for setting in sweep.settings
    ]
    return min(scenes) >= MIN_SCENES


def comparable(sweep: Multirun, at: Column) -> bool:
    """Return whether all settings have the same ground truth in a column."""
    parts = [
        trials[(trials["category"] == at.category) & (trials["cell_width"] == at.cell_width)]
        for trials in (setting.trials for setting in sweep.settings)
    ]
    filled = [part for part in parts if len(part)]
    return all(same_ground_truth(filled[0], part) for part in filled[1:])


def same_ground_truth(ours: pd.DataFrame, theirs: pd.DataFrame) -> bool:
    """Return whether two sets of trials have common scenes, and the same ground-truth pixels in each of them."""
    pixels = [part.groupby("scene")[PIXELS[2]].max().to_dict() for part in (ours, theirs)]
    common = pixels[0].keys() & pixels[1].keys()
    return bool(common) and all(pixels[0][scene] == pixels[1][scene] for scene in common)
