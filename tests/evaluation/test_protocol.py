"""The mapping task in hand-made rooms, with a predictor that knows the truth."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from imagination.evaluation import saved_maps, trials
from imagination.evaluation.metrics import mean_iou, pooled_iou
from imagination.evaluation.protocol import ModelUnderTest
from imagination.evaluation.records import Key, Report
from imagination.evaluation.trials import Trial, ViewpointSampling, views_of
from imagination.evaluation.viewpoints import Viewpoints
from imagination.reporting.tables import mapping_rows
from imagination.utils.errors import UserError
from tests.helpers.toy_evaluation import Perfect, make_protocol, make_subject

SCENES = ["val_0", "test_1"]


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> ModelUnderTest:
    return make_subject(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def report(subject: ModelUnderTest) -> Report:
    protocol = make_protocol()
    return protocol.evaluate(subject, SCENES, protocol.select_thresholds(subject, SCENES))


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


def test_a_half_blind_segmentation_maps_less_than_a_perfect_one(report: Report) -> None:
    for category in ("chair", "bed"):
        correct = {
            name: int(report.counts[Key(name, category, 1.0)][..., 0].sum())
            for name in ("seg_gt", "seg_hrnet")
        }
        assert 0 < correct["seg_hrnet"] < correct["seg_gt"]
        assert 0 < report.first_person[category] < 1


def test_the_oracle_bounds_what_can_be_imagined(report: Report) -> None:
    for key, counts in report.counts.items():
        if key.approach == "oracle":
            assert (counts[..., 1] == 0).all()
            assert (counts[..., 0] >= 0.9 * report.counts[key._replace(approach="imagination")][..., 0]).all()


def test_seen_cells_are_a_part_of_all(report: Report) -> None:
    for key, counts in report.counts.items():
        assert (report.seen[key] <= counts).all()
        assert report.seen[key][..., 2].any()
    assert any((report.seen[key] < counts).any() for key, counts in report.counts.items())


def test_every_run_is_measured_against_the_whole_homes_truth(subject: ModelUnderTest, report: Report) -> None:
    for (_, category, _), counts in report.counts.items():
        assert counts.shape == (2, 2, 3)
        layer = subject.pool.observer.categories.index(category) - 1
        for place, scene in enumerate(SCENES):
            truth = subject.pool.observer.truth(scene).truth[layer].sum()
            assert (counts[place, :, 2] == truth).all()
            assert (counts[place, :, 0] <= truth).all()


def test_the_choice_is_the_best_of_all_candidates_together(subject: ModelUnderTest, report: Report) -> None:
    """Measuring on the scenes that the choice was made on gives its IoU, pooled over all cell widths."""
    for (approach, category), choice in report.choices.items():
        both = np.concatenate([report.counts[Key(approach, category, width)] for width in (1.5, 1.0)])
        assert pooled_iou(both) == pytest.approx(choice.iou)
        assert 0 <= mean_iou(both) <= 1


def test_a_threshold_that_is_given_is_not_chosen(subject: ModelUnderTest, report: Report) -> None:
    fixed = make_protocol(threshold=0.3).select_thresholds(subject, SCENES)
    assert fixed.keys() == report.choices.keys()
    assert {choice.threshold for choice in fixed.values()} == {0.3}
    assert all(choice.iou <= report.choices[key].iou for key, choice in fixed.items())
    assert any(choice.iou < report.choices[key].iou for key, choice in fixed.items())


def test_the_same_seed_gives_the_same_report_and_renders_nothing_again(
    subject: ModelUnderTest, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "_look", lambda *_: pytest.fail("rendered again"))
    protocol = replace(make_protocol(), cell_widths=[1.0])
    again = protocol.evaluate(subject, SCENES, report.choices)
    for key, counts in again.counts.items():
        assert (counts == report.counts[key]).all()


def test_views_depend_on_seed_home_width_and_set(subject: ModelUnderTest) -> None:
    observer = subject.pool.observer
    first = views_of(observer, Trial("val_0", 1.5, 0), ViewpointSampling(0, 2))["pose"]
    assert len(first) % 2 == 0
    assert (first[::2, :2] == first[1::2, :2]).all()  # two headings at each viewpoint
    for run, sampling in [
        (Trial("val_0", 1.5, 1), ViewpointSampling(0, 2)),
        (Trial("val_0", 1.5, 0), ViewpointSampling(1, 2)),
    ]:
        other = views_of(observer, run, sampling)["pose"]
        assert other.shape != first.shape or (other != first).any()


def test_the_order_of_updates_matters_to_the_moving_average_alone(report: Report) -> None:
    for key, counts in report.counts.items():
        if key.approach == "seg_gt":
            assert (report.shuffled[key] == counts).all()
    assert any((report.shuffled[key] != counts).any() for key, counts in report.counts.items())


def test_a_category_that_no_home_contains_is_refused(tmp_path: Path) -> None:
    nothing = make_subject(tmp_path, ("chair", "sofa"), count=1)
    with pytest.raises(UserError, match="'sofa': none of the 1 scenes"):
        make_protocol().select_thresholds(nothing, ["val_0"])


def test_homes_without_the_category_are_left_out(subject: ModelUnderTest, report: Report) -> None:
    observer = subject.pool.observer
    full = observer.truth("val_0")
    observer._truths["val_0"] = full._replace(truth=full.truth & (np.arange(4) != 1)[:, None, None])
    try:
        found = make_protocol().evaluate(subject, SCENES, report.choices)
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
        ({"known_scenes": -1}, "known_scenes: got -1"),
        ({"threshold": 0.305}, "evaluation.threshold: got 0.305"),
        ({"precision": "half"}, "evaluation.precision: got 'half'"),
        ({"cell_widths": [0.0]}, r"cell_widths: got 0\.0"),
        ({"cell_widths": []}, "cell_widths: got 0"),
        ({"cell_widths": [3, 2.0, 3.0]}, r"cell_widths: got \[3, 2\.0, 3\.0\], expected each width once"),
        ({"viewpoint_sets": 0}, "viewpoint_sets: got 0"),
        ({"orientations": 0}, "orientations: got 0"),
    ],
)
def test_settings_out_of_range_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_protocol(**change)


def test_a_home_too_small_for_the_cell_width_counts_with_empty_maps(
    subject: ModelUnderTest, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = Viewpoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    monkeypatch.setattr(trials, "sparse_viewpoints", lambda *_: nothing)
    found = make_protocol(cell_widths=[9.0]).evaluate(subject, SCENES, report.choices)
    for counts in found.counts.values():
        assert (counts[..., :2] == 0).all()
        assert (counts[..., 2] > 0).all()
    assert [len(distances) for distances in found.snap_distances] == [0] * 4


def test_tables_can_be_recounted_from_the_saved_maps(
    subject: ModelUnderTest, report: Report, tmp_path: Path
) -> None:
    """With numpy alone, from the files alone."""
    protocol = make_protocol()
    found = protocol.evaluate(
        subject, SCENES, report.choices, save=lambda maps: saved_maps.save(tmp_path, maps)
    )
    totals: dict[tuple[str, str, str], np.ndarray] = {}
    for path in sorted((tmp_path / "maps").iterdir()):
        with np.load(path, allow_pickle=False) as file:
            predicted = file["level"] >= file["threshold"][..., None, None]
            assert predicted.shape[2:] == file["occupied"].shape == file["seen"].shape
            for (a, name), (c, category) in product(
                enumerate(file["approaches"]), enumerate(file["categories"])
            ):
                if file["present"][c]:
                    mine, truth, seen = predicted[a, c], file["truth"][c], file["seen"]
                    whole = mine & truth, mine & ~truth, truth
                    outcomes = *whole, *(cells & seen for cells in whole)
                    key = str(name), str(category), f"{file['cell_width']:g}"
                    totals[key] = totals.get(key, 0) + np.array([np.sum(cells) for cells in outcomes])
    rows = mapping_rows(found, protocol, 0.1)
    assert len(rows) == len(totals) == 7 * 2 * 2
    for row in rows:
        recounted = totals[row["approach"], row["category"], row["cell_width"]].tolist()
        correct, false, truth = recounted[:3]
        told = [int(row[name]) for name in ("correct_pixels", "false_positives", "gt_pixels")]
        assert told == [correct, false, truth]
        assert float(row["iou_pooled"]) == pytest.approx(correct / (truth + false), abs=5e-5)
        of_row = Key(row["approach"], row["category"], float(row["cell_width"]))
        assert found.seen[of_row].sum(axis=(0, 1)).tolist() == recounted[3:]


def test_saved_maps_are_read_as_they_were(subject: ModelUnderTest, report: Report, tmp_path: Path) -> None:
    kept: list[saved_maps.SavedMaps] = []
    make_protocol(cell_widths=[1.0]).evaluate(subject, SCENES[:1], report.choices, save=kept.append)
    for maps in kept:
        saved_maps.save(tmp_path, maps)
        path = saved_maps.path_of(tmp_path, maps.run)
        before = path.read_bytes()
        again = saved_maps.load(path)
        assert again.run == maps.run and again.grid == maps.grid and again.approaches == maps.approaches
        assert (again.predicted == maps.predicted).all() and (again.truth == maps.truth).all()
        saved_maps.save(tmp_path, again)
        assert path.read_bytes() == before
        # cropped to what it holds, at its place: the truth's cells lie where the scene's do
        scene = subject.pool.observer.truth(maps.run.scene)
        points = maps.grid.to_points(np.argwhere(maps.truth[0]))
        row, column = scene.grid.to_cells(points).T
        assert scene.truth[0][row, column].all() and len(points) == scene.truth[0].sum()
    path.write_bytes(before[:100])
    with pytest.raises(UserError, match="is damaged or no file of maps"):
        saved_maps.load(path)


def test_an_evaluation_that_stopped_goes_on_where_it_was(tmp_path: Path) -> None:
    protocol, subject = make_protocol(cell_widths=[1.5]), make_subject(tmp_path)

    class Stops(Perfect):
        calls = 0

        def __call__(self, views, wanted):
            Stops.calls += 1
            if Stops.calls == 3:
                raise KeyboardInterrupt
            return super().__call__(views, wanted)

    stops = subject._replace(predict=Stops(subject.setting.layers))
    with pytest.raises(KeyboardInterrupt):
        protocol.select_thresholds(stops, SCENES)
    choices = protocol.select_thresholds(stops, SCENES)
    assert Stops.calls == 3 + 2  # the runs of the second scene; the first's were done
    assert choices == protocol.select_thresholds(subject, SCENES)
    assert choices == protocol.select_thresholds(subject._replace(keep=False), SCENES)
    other = subject._replace(predict=Stops(subject.setting.layers, fingerprint="others"))
    protocol.select_thresholds(other, SCENES)
    assert Stops.calls == 3 + 2 + 4  # other networks, other results


def test_workers_change_nothing(subject: ModelUnderTest, report: Report, tmp_path: Path) -> None:
    several = make_subject(tmp_path, workers=2)
    protocol = make_protocol(cell_widths=[1.0])
    try:
        found = protocol.evaluate(several, SCENES, report.choices)
    finally:
        several.pool.close()
    for key, counts in found.counts.items():
        assert (counts == report.counts[key]).all() and (found.shuffled[key] == report.shuffled[key]).all()


def test_approaches_that_lack_their_network_are_left_out_unless_asked_for() -> None:
    protocol = make_protocol()
    assert list(protocol.available({"maps"}).approaches) == [
        "seg_gt", "imagination_seen", "seen_dilated", "imagination", "imagination_dilated", "oracle",
    ]  # fmt: skip
    assert list(protocol.available({"images"}).approaches) == ["seg_gt", "seg_hrnet", "oracle"]
    some = make_protocol(only=["imagination", "seg_gt"])
    assert list(some.available({"maps"}).approaches) == ["imagination", "seg_gt"]
    with pytest.raises(UserError, match="got seg_hrnet, which needs a checkpoint of a segmentation network"):
        make_protocol(only=["seg_gt", "seg_hrnet"]).available({"maps"})
    with pytest.raises(UserError, match=r"evaluation\.only: got 'seg_gd', expected one of: imagination, "):
        make_protocol(only=["seg_gd"]).available({"maps"})
