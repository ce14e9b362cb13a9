"""Figures agree with the maps: curves by brute force, the median trial, arrows and bars in the map's frame."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure

from imagination.evaluation.trials import Trial
from imagination.geometry.grid import Grid
from imagination.reporting.content import of_run
from imagination.reporting.figures.maps import (
    counts_by_threshold,
    draw_poses,
    draw_scale_bar,
    draw_viewpoints,
    typical,
)
from imagination.reporting.figures.scores import precision_recall, reliability
from imagination.reporting.html import drawings
from imagination.reporting.load_run import Results
from imagination.reporting.style import COLOURS, LABELS, MEANINGS, colours, label, theme
from tests.conftest import ROOT
from tests.helpers.run_folders import WITHOUT_BED, make_folder, make_maps


def test_maps_are_counted_at_every_threshold() -> None:
    rng = np.random.default_rng(1)
    maps = [make_maps(Trial(scene, 3.0, 0), rng) for scene in ("test_0000", WITHOUT_BED)]
    counts = counts_by_threshold(maps)["mine", "bed"]
    level, gt = maps[0].level[3, 1], maps[0].truth[1]
    for step in (1, 30, 99):
        predicted = level >= step
        expected = [(predicted & gt).sum(), (predicted & ~gt).sum(), gt.sum()]
        assert counts[step - 1].tolist() == expected


def test_precision_recall_and_reliability_by_brute_force() -> None:
    rng = np.random.default_rng(2)
    score, truth = rng.integers(1, 100, 5000), rng.random(5000)
    hit = truth < score / 100  # calibrated, as far as chance goes
    confusion_counts = np.array(
        [[(hit & (score >= t)).sum(), (~hit & (score >= t)).sum(), hit.sum()] for t in range(1, 100)]
    )
    precision, recall = precision_recall(confusion_counts)
    assert precision[49] == pytest.approx(hit[score >= 50].mean())
    assert recall[49] == pytest.approx((hit & (score >= 50)).sum() / hit.sum())
    means, shares = reliability(confusion_counts)
    assert len(means) == 10
    for place in range(10):
        inside = (score >= 10 * place) & (score < 10 * place + 10)
        assert shares[place] == pytest.approx(hit[inside].mean())
        assert means[place] == pytest.approx((score[inside] / 100 + 0.005).mean())
    assert np.abs(means - shares).max() < 0.08


def test_the_typical_trial_is_the_median() -> None:
    rng = np.random.default_rng(3)
    maps = [make_maps(Trial("test_0000", 2.0, number), rng) for number in range(5)]
    scores = []
    for saved in maps:
        predicted, gt = saved.predicted[2, 0], saved.truth[0]
        scores.append((predicted & gt).sum() / (predicted | gt).sum())
    median = typical(maps, "chair", 2.0)
    assert median is not None and median.trial.number == int(np.argsort(scores)[2])
    assert typical(maps, "chair", 3.0) is None


def test_maps_are_the_right_way_up_and_to_scale() -> None:
    """A robot at a known place looking along +y: its arrow points to smaller rows, and the bar is two metres."""
    grid = Grid(0.1, 100, 80, (-2.0, -3.0))
    figure = Figure()
    axis = figure.subplots()
    axis.imshow(np.zeros((100, 80)))
    draw_poses(axis, np.array([[0.05, 0.05, np.pi / 2]]), grid, (slice(10, 90), slice(5, 80)))
    arrows = axis.collections[0]
    assert arrows.get_offsets().tolist() == [[20 - 5, 69 - 10]]  # column and row of the cell, in the window
    assert float(arrows.U[0]) == pytest.approx(0, abs=1e-6)  # type: ignore[attr-defined]
    assert float(arrows.V[0]) == pytest.approx(-5)  # type: ignore[attr-defined]
    assert axis.get_ylim()[0] > axis.get_ylim()[1]  # rows grow downwards
    draw_scale_bar(axis, grid.resolution)
    bar = axis.lines[-1].get_xdata()
    assert np.ptp(bar) * grid.resolution == pytest.approx(2.0)


def test_known_approaches_keep_their_colours_and_others_get_their_own() -> None:
    few, many = (
        colours(["imagination", "mine"]),
        colours(["seg_gt", "mine", "imagination", "yours"]),
    )
    assert few["imagination"] == many["imagination"]
    assert few["mine"] == many["mine"]
    assert len(set(many.values())) == 4
    assert label("mine") == "mine"


def test_every_figure_of_a_folder_is_drawn_in_both_themes(tmp_path: Path) -> None:
    content = of_run(Results(make_folder(tmp_path / "run")))
    stems = [drawing.stem for drawing in drawings(content)]
    assert len(set(stems)) == len(stems)
    for kind in ("distribution_iou", "distribution_correct_pixels", "maps", "single", "precision_recall_maps",
                 "precision_recall_views", "reliability_maps", "reliability_network"):  # fmt: skip
        assert {f"{kind}_chair", f"{kind}_bed"} <= set(stems)
    assert "viewpoints" in stems
    with theme("dark"):
        figure = next(drawings(content)).draw()
        assert figure.get_facecolor() != (1, 1, 1, 1)
        axis = figure.axes[0]
        assert axis.get_xlabel() == "cell width, m" and axis.get_ylabel() == "IoU of a trial"


def test_every_approach_that_we_evaluate_has_a_name_a_meaning_and_a_colour() -> None:
    usual = yaml.safe_load((ROOT / "conf/evaluation/default.yaml").read_text())
    study = yaml.safe_load((ROOT / "conf/study/paper.yaml").read_text())
    names = set(usual["approaches"]) | set(study["evaluation"]["approaches"])
    for known in (LABELS, MEANINGS, COLOURS):
        assert set(known) == names
    assert len(set(COLOURS.values())) == len(names)


def test_each_viewpoint_set_is_drawn_once() -> None:
    """Two of the widest cell width and one of the narrowest; with one width, as in a sweep's jobs, two of it."""
    rng = np.random.default_rng(4)
    maps = [
        make_maps(Trial("test_0000", width, number), rng) for width in (3.0, 2.5, 2.0) for number in (0, 1)
    ]
    for some, shown in (
        (maps, ["3 m, set 0", "3 m, set 1", "2 m, set 0"]),
        (maps[:2], ["3 m, set 0", "3 m, set 1"]),
    ):
        titles = [axis.get_title().partition("\n")[0] for axis in draw_viewpoints(some).axes]
        assert titles == [f"test_0000, cell width {title}" for title in shown]
