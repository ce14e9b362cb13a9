"""The mapping task in hand-made rooms, with a predictor that knows the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imagination.errors import UserError
from imagination.evaluation import runs
from imagination.evaluation.metrics import mean_iou, pooled_iou
from imagination.evaluation.outcome import Key, Report
from imagination.evaluation.protocol import Subject
from imagination.evaluation.runs import Looks, Run, views_of
from imagination.views.viewpoints import Viewpoints
from tests.evaluation.subjects import make_protocol, make_subject

HOMES = ["val_0", "test_1"]


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Subject:
    return make_subject(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def report(subject: Subject) -> Report:
    protocol = make_protocol()
    return protocol.measure(subject, HOMES, protocol.choose(subject, HOMES))


def test_a_perfect_prediction_maps_nearly_everything(report: Report) -> None:
    """Nearly: cells are pulled twice, by nearest neighbour and bilinearly, at random headings."""
    for category in ("chair", "bed"):
        scores = {
            name: pooled_iou(report.counts[Key(name, category, 1.0)]) for name in make_protocol().approaches
        }
        assert scores["imagination"] > 0.8
        assert scores["imagination"] > scores["imagination_seen"]
        assert scores["seg_gt"] > 0.25
        choices = report.choices
        assert choices["seen_dilated", category].iou >= choices["imagination_seen", category].iou


def test_every_run_is_measured_against_the_whole_homes_truth(subject: Subject, report: Report) -> None:
    for (_, category, _), counts in report.counts.items():
        assert counts.shape == (2, 2, 3)
        layer = subject.pool.observer.categories.index(category) - 1
        for place, home in enumerate(HOMES):
            truth = subject.pool.observer.truth(home).truth[layer].sum()
            assert (counts[place, :, 2] == truth).all()
            assert (counts[place, :, 0] <= truth).all()


def test_the_choice_is_the_best_of_all_candidates_together(subject: Subject, report: Report) -> None:
    """Measuring on the homes that the choice was made on gives its IoU, pooled over all cell widths."""
    for (approach, category), choice in report.choices.items():
        both = np.concatenate([report.counts[Key(approach, category, width)] for width in (1.5, 1.0)])
        assert pooled_iou(both) == pytest.approx(choice.iou)
        assert 0 <= mean_iou(both) <= 1


def test_the_same_seed_gives_the_same_report_and_renders_nothing_again(
    subject: Subject, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "_look", lambda *_: pytest.fail("rendered again"))
    protocol = replace(make_protocol(), cell_widths=[1.0])
    again = protocol.measure(subject, HOMES, report.choices)
    for key, counts in again.counts.items():
        assert (counts == report.counts[key]).all()


def test_views_depend_on_seed_home_width_and_set(subject: Subject) -> None:
    observer = subject.pool.observer
    first = views_of(observer, Run("val_0", 1.5, 0), Looks(0, 2))["pose"]
    assert len(first) % 2 == 0
    assert (first[::2, :2] == first[1::2, :2]).all()  # two headings at each viewpoint
    for run, looks in [(Run("val_0", 1.5, 1), Looks(0, 2)), (Run("val_0", 1.5, 0), Looks(1, 2))]:
        other = views_of(observer, run, looks)["pose"]
        assert other.shape != first.shape or (other != first).any()


def test_the_order_of_updates_matters_to_the_moving_average_alone(report: Report) -> None:
    for key, counts in report.counts.items():
        if key.approach == "seg_gt":
            assert (report.shuffled[key] == counts).all()
    assert any((report.shuffled[key] != counts).any() for key, counts in report.counts.items())


def test_a_category_that_no_home_contains_is_refused(tmp_path: Path) -> None:
    nothing = make_subject(tmp_path, ("chair", "sofa"), count=1)
    with pytest.raises(UserError, match="'sofa': none of the 1 homes"):
        make_protocol().choose(nothing, ["val_0"])


def test_homes_without_the_category_are_left_out(subject: Subject, report: Report) -> None:
    observer = subject.pool.observer
    full = observer.truth("val_0")
    observer._truths["val_0"] = full._replace(truth=full.truth & (np.arange(4) != 1)[:, None, None])
    try:
        found = make_protocol().measure(subject, HOMES, report.choices)
    finally:
        observer._truths["val_0"] = full
    assert found.left_out == {"chair": [], "bed": ["val_0"]}
    assert found.counts[Key("imagination", "bed", 1.0)].shape == (1, 2, 3)
    assert (
        found.counts[Key("imagination", "bed", 1.0)][0] == report.counts[Key("imagination", "bed", 1.0)][1]
    ).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cell_widths": [0.0]}, r"cell_widths: got 0\.0"),
        ({"cell_widths": []}, "cell_widths: got 0"),
        ({"viewpoint_sets": 0}, "viewpoint_sets: got 0"),
        ({"orientations": 0}, "orientations: got 0"),
    ],
)
def test_settings_out_of_range_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_protocol(**change)


def test_a_home_too_small_for_the_cell_width_counts_with_empty_maps(
    subject: Subject, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = Viewpoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    monkeypatch.setattr(runs, "sparse_viewpoints", lambda *_: nothing)
    found = make_protocol(cell_widths=[9.0]).measure(subject, HOMES, report.choices)
    for counts in found.counts.values():
        assert (counts[..., :2] == 0).all()
        assert (counts[..., 2] > 0).all()
    assert [len(distances) for distances in found.snap_distances] == [0] * 4
