"""Furniture of the splits: disjoint ranges in every family, and families in the test split only."""

from itertools import combinations, product

import numpy as np
import pytest

from imagination.scenes.procedural.furniture.families import FAMILIES
from imagination.scenes.procedural.furniture.styles import draw_style, families_of
from imagination.scenes.source import SPLITS

CATEGORIES = {
    "chair": {"chair", "office_chair", "armchair"},
    "table": {"dining_table", "desk", "coffee_table", "side_table"},
    "bed": {"double_bed", "single_bed", "bunk_bed"},
}
SPLIT_FAMILIES = {split: families_of(split) for split in SPLITS}


@pytest.mark.parametrize(("one", "other"), list(combinations(SPLITS, 2)))
def test_ranges_of_two_splits_are_disjoint(one, other) -> None:
    compared = 0
    for label in SPLIT_FAMILIES[one].keys() & SPLIT_FAMILIES[other].keys():
        first, second = SPLIT_FAMILIES[one][label], SPLIT_FAMILIES[other][label]
        for family in first.keys() & second.keys():
            assert first[family].keys() == second[family].keys()
            for name in first[family]:
                for a, b in product(first[family][name], second[family][name]):
                    assert a.high < b.low or b.high < a.low, (family, name, a, b)
                    compared += 1
    assert compared > 100


def test_test_ranges_are_next_to_training_ranges_on_both_sides() -> None:
    for label, families in SPLIT_FAMILIES["train"].items():
        for family in families.keys() & SPLIT_FAMILIES["test"][label].keys():
            for name, (train,) in families[family].items():
                below, above = SPLIT_FAMILIES["test"][label][family][name]
                assert below.high < train.low < train.high < above.low
                assert max(train.low - below.high, above.low - train.high) < 0.3 * (above.high - below.low)


@pytest.mark.parametrize("category", CATEGORIES)
def test_some_families_of_each_category_are_held_out(category) -> None:
    names = {
        split: {name for label in CATEGORIES[category] for name in SPLIT_FAMILIES[split][label]}
        for split in SPLITS
    }
    assert len(names["test"] - names["train"] - names["val"]) >= 2
    assert (
        names["val"] == names["train"] & names["test"]
    )  # validation has neither test-only nor train-only families


def test_names_are_unique_and_each_split_has_each_label() -> None:
    assert len({family.name for family in FAMILIES}) == len(FAMILIES)
    labels = set().union(*CATEGORIES.values())
    assert all(set(SPLIT_FAMILIES[split]) == labels for split in SPLITS)


@pytest.mark.parametrize("split", SPLITS)
def test_styles_are_drawn_from_their_splits_ranges(split) -> None:
    rng = np.random.default_rng(0)
    for label in SPLIT_FAMILIES[split]:
        for _ in range(30):
            style = draw_style(label, split, rng)
            ranges = SPLIT_FAMILIES[split][label][style.family.name]
            assert set(style.values) == set(ranges)
            for name, value in style.values.items():
                assert any(low <= value <= high for low, high in ranges[name])


def test_models_differ_between_styles() -> None:
    rng = np.random.default_rng(1)
    assert len({draw_style("chair", "train", rng).model for _ in range(50)}) == 50
