"""Counts of an interrupted evaluation, recounted from its saved maps, and messages on what it lacks."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import pandas as pd

from imagination.evaluation.metrics import count
from imagination.evaluation.record_files import PIXELS, TRIAL_KEY
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.trials import Trial
from imagination.reporting.saved_config import at


def recount(maps: Sequence[SavedMaps]) -> pd.DataFrame:
    """Return the counts of every trial over whole maps and seen cells, computed from its saved maps."""
    rows = []
    columns = [*TRIAL_KEY, *PIXELS, *(f"{name}_seen" for name in PIXELS)]
    for saved in maps:
        predicted = saved.predicted
        for (index, approach), (layer, category) in product(
            enumerate(saved.approaches), enumerate(saved.categories)
        ):
            if saved.present[layer]:
                pixels = count(predicted[index, layer], saved.truth[layer])
                seen = count(predicted[index, layer] & saved.seen, saved.truth[layer] & saved.seen)
                scene, width, number = saved.trial
                rows.append((approach, category, width, scene, number, *pixels.tolist(), *seen.tolist()))
    return pd.DataFrame(rows, columns=columns)


def missing_trials(trials: pd.DataFrame, config: Mapping[str, Any]) -> list[str]:
    """Return one message for each approach, category and cell width of the config that has missing trials."""
    if trials.empty:
        return []  # reported already
    sets = range(int(at(config, "evaluation.viewpoint_sets") or 0))
    found = set(trials[list(TRIAL_KEY)].itertuples(index=False, name=None))
    messages = []
    for category in config.get("unit_categories") or []:
        scenes = trials[trials["category"] == category]["scene"].unique()
        if not len(scenes):
            messages.append(f"{category}: no trial of any approach")
        places = product(at(config, "evaluation.cell_widths") or [], trials["approach"].unique())
        for width, approach in places:
            expected = product(scenes, sets)
            if missing := [
                trial for trial in expected if (approach, category, float(width), *trial) not in found
            ]:
                names = ", ".join(f"{scene} set {number}" for scene, number in missing[:3])
                messages.append(
                    f"{approach}, {category}, cell width {float(width):g} m: {len(missing)} of "
                    f"{len(scenes) * len(sets)} trials missing ({names}{', …' if len(missing) > 3 else ''})"
                )
    return messages


def missing_maps(trials: pd.DataFrame, maps: Sequence[SavedMaps]) -> list[str]:
    """Return a message on counted trials without saved maps, or an empty list if there are none."""
    saved = {each.trial for each in maps}
    places = trials[["scene", "cell_width", "viewpoint_set"]].drop_duplicates()
    counted = [Trial(*place) for place in places.itertuples(index=False, name=None)]
    missing = [trial for trial in counted if trial not in saved]
    if not missing:
        return []
    names = ", ".join(f"{trial.scene} {trial.cell_width:g} m set {trial.number}" for trial in missing[:3])
    more = ", …" if len(missing) > 3 else ""
    return [f"maps/: the maps of {len(missing)} of {len(counted)} trials are missing ({names}{more})"]
