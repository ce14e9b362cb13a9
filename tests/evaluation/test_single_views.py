"""Single views: what is ranked and shown, counts at every threshold, and files that give the same back."""

from pathlib import Path

import numpy as np
import pytest

from imagination.evaluation import single_views
from imagination.evaluation.protocol import ModelUnderTest
from imagination.evaluation.single_views import SingleViews, _Ranked, picks
from imagination.evaluation.threshold_selection import THRESHOLDS
from imagination.evaluation.trials import Trial
from imagination.utils.errors import UserError
from tests.helpers.toy_evaluation import make_model, make_protocol

SCENES = ["val_0", "test_1"]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ModelUnderTest:
    return make_model(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def singles(model: ModelUnderTest) -> SingleViews:
    protocol = make_protocol(cell_widths=[1.5], viewpoint_sets=1)
    return single_views.evaluate_single_views(
        protocol, model, SCENES, protocol.select_thresholds(model, SCENES), 9
    )


def test_a_perfect_unit_is_perfect_on_what_it_should_imagine(singles: SingleViews) -> None:
    """Its prediction is the whole ground-truth crop; V_valid reduces it to about the label."""
    assert singles.views > 4
    for category in ("chair", "bed"):
        by_rank = {view.rank: view for view in singles.shown if view.category == category}
        assert list(by_rank) == ["best", "median", "worst"]
        assert by_rank["best"].iou >= by_rank["median"].iou >= by_rank["worst"].iou
        assert by_rank["best"].iou > 0.8
        view = by_rank["best"]
        predicted = view.predicted["imagination"]
        assert view.iou == pytest.approx((predicted & view.label).sum() / (predicted | view.label).sum())
        assert set(np.unique(view.probabilities)) <= {0.0, 1.0}
        assert list(view.predicted) == list(make_protocol().approaches)
        correct, _, gt = singles.counts["imagination", category][49].tolist()
        assert correct <= gt and correct > 0.7 * gt


def test_seen_and_other_cells_add_up_to_all(singles: SingleViews) -> None:
    for category in ("chair", "bed"):
        parts = (singles.cells[part, category] for part in ("seen", "unseen"))
        assert (sum(parts) == singles.cells["all", category]).all()
    rows = single_views.threshold_rows(singles)
    assert len(rows) == len(THRESHOLDS) * (len(singles.counts) + len(singles.cells))
    assert {row["approach"] for row in rows} == {*make_protocol().approaches, "network"}


def test_without_a_unit_the_others_are_shown(model: ModelUnderTest) -> None:
    from dataclasses import replace

    images = model._replace(predict=replace(model.predict, gives=frozenset({"images"})))  # type: ignore[type-var]
    protocol = make_protocol(cell_widths=[1.5], viewpoint_sets=1).available({"images"})
    found = single_views.evaluate_single_views(
        protocol, images, SCENES, protocol.select_thresholds(images, SCENES), 9
    )
    assert found.cells == {} and np.isnan(found.shown[0].probabilities).all()
    assert "seg_hrnet" in found.shown[0].predicted and "imagination" not in found.shown[0].predicted


def test_best_median_and_worst_are_by_iou_then_by_size() -> None:
    trial = Trial("scene", 2.0, 0)

    def view(iou: float, size: int, index: int) -> _Ranked:
        return _Ranked(iou, size, trial, index)

    views = [view(0.0, 20, 0), view(0.0, 90, 1), view(0.4, 30, 2), view(0.9, 40, 3), view(0.9, 50, 4),
             view(1.0, 3, 5), view(1.0, 0, 6)]  # fmt: skip
    assert {rank: ranked.view_index for rank, ranked in picks(views, 0.1).items()} == {
        "best": 4,
        "median": 2,
        "worst": 1,
    }
    small = [view(0.2, 1, 0), view(0.7, 2, 1)]  # all below a tenth of a square metre
    assert picks(small, 0.1)["best"].view_index == 1
    assert picks([view(0.0, 0, 0)], 0.1) == {}


def test_files_give_the_views_back(tmp_path: Path, singles: SingleViews) -> None:
    single_views.write(tmp_path, singles)
    shown, resolution = single_views.load(tmp_path / single_views.FILE)
    assert resolution == pytest.approx(0.1)
    for before, after in zip(singles.shown, shown, strict=True):
        assert before[:3] == after[:3] and before.iou == after.iou
        assert (before.rgb == after.rgb).all() and (before.label == after.label).all()
        assert all((before.predicted[name] == after.predicted[name]).all() for name in before.predicted)
    first = (tmp_path / single_views.FILE).read_bytes()
    single_views.write(tmp_path, singles)
    assert (tmp_path / single_views.FILE).read_bytes() == first
    (tmp_path / single_views.FILE).write_bytes(first[:200])
    with pytest.raises(UserError, match=rf"single views: .*{single_views.FILE}"):
        single_views.load(tmp_path / single_views.FILE)
