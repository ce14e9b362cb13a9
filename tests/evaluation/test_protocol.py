"""The mapping task in hand-made rooms, with a predictor that returns the ground truth."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from imagination.evaluation import saved_maps, trials
from imagination.evaluation.protocol import ModelUnderTest
from imagination.evaluation.records import Key, Report
from imagination.evaluation.trials import Trial, ViewpointSampling, views_of
from imagination.evaluation.viewpoints import Viewpoints
from imagination.scenes.categories import CategoryTable
from imagination.utils.errors import UserError
from tests.helpers.pooled import mean_iou, pooled_iou
from tests.helpers.toy_evaluation import Perfect, make_model, make_protocol

SCENES = ["val_0", "test_1"]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ModelUnderTest:
    return make_model(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def report(model: ModelUnderTest) -> Report:
    protocol = make_protocol()
    return protocol.evaluate(model, SCENES, protocol.select_thresholds(model, SCENES))


def test_a_perfect_prediction_maps_nearly_everything(report: Report) -> None:
    """Nearly: cells are pulled twice, by nearest neighbour and bilinearly, at random headings."""
    for category in ("chair", "bed"):
        scores = {
            name: pooled_iou(report.counts[Key(name, category, 1.0)]) for name in make_protocol().approaches
        }
        assert scores["imagination"] > 0.8
        assert scores["imagination"] > scores["imagination_seen"]
        assert scores["seg_gt"] > 0.25
        selected = report.selected
        assert selected["seen_dilated", category].iou >= selected["imagination_seen", category].iou


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


def test_every_trial_is_compared_with_the_ground_truth_of_the_whole_scene(
    model: ModelUnderTest, report: Report
) -> None:
    for (_, category, _), counts in report.counts.items():
        assert counts.shape == (2, 2, 3)
        layer = model.pool.observer.categories.index(category) - 1
        for place, scene in enumerate(SCENES):
            gt_pixels = model.pool.observer.ground_truth(scene).truth[layer].sum()
            assert (counts[place, :, 2] == gt_pixels).all()
            assert (counts[place, :, 0] <= gt_pixels).all()


def test_the_selected_threshold_is_the_best_over_all_cell_widths(
    model: ModelUnderTest, report: Report
) -> None:
    """Evaluation on the scenes of the selection gives its IoU, pooled over all cell widths."""
    for (approach, category), selected in report.selected.items():
        both = np.concatenate([report.counts[Key(approach, category, width)] for width in (1.5, 1.0)])
        assert pooled_iou(both) == pytest.approx(selected.iou)
        assert 0 <= mean_iou(both) <= 1


def test_a_given_threshold_is_not_selected(model: ModelUnderTest, report: Report) -> None:
    fixed = make_protocol(threshold=0.3).select_thresholds(model, SCENES)
    assert fixed.keys() == report.selected.keys()
    assert {selected.threshold for selected in fixed.values()} == {0.3}
    assert all(selected.iou <= report.selected[key].iou for key, selected in fixed.items())
    assert any(selected.iou < report.selected[key].iou for key, selected in fixed.items())


def test_the_same_seed_gives_the_same_report_and_renders_nothing_again(
    model: ModelUnderTest, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "_render", lambda *_: pytest.fail("rendered again"))
    protocol = replace(make_protocol(), cell_widths=[1.0])
    again = protocol.evaluate(model, SCENES, report.selected)
    for key, counts in again.counts.items():
        assert (counts == report.counts[key]).all()


def test_views_depend_on_seed_and_viewpoint_set(model: ModelUnderTest) -> None:
    observer = model.pool.observer
    first = views_of(observer, Trial("val_0", 1.5, 0), ViewpointSampling(0, 2))["pose"]
    assert len(first) % 2 == 0
    assert (first[::2, :2] == first[1::2, :2]).all()  # two headings at each viewpoint
    for trial, sampling in [
        (Trial("val_0", 1.5, 1), ViewpointSampling(0, 2)),
        (Trial("val_0", 1.5, 0), ViewpointSampling(1, 2)),
    ]:
        other = views_of(observer, trial, sampling)["pose"]
        assert other.shape != first.shape or (other != first).any()


def test_the_order_of_updates_matters_to_the_moving_average_alone(report: Report) -> None:
    for key, counts in report.counts.items():
        if key.approach == "seg_gt":
            assert (report.shuffled[key] == counts).all()
    assert any((report.shuffled[key] != counts).any() for key, counts in report.counts.items())


def test_a_category_that_no_scene_contains_is_refused(tmp_path: Path) -> None:
    nothing = make_model(tmp_path, ("chair", "sofa"), count=1)
    with pytest.raises(UserError, match=r"'sofa'.*1 scenes"):
        make_protocol().select_thresholds(nothing, ["val_0"])


def test_scenes_without_the_category_are_left_out(model: ModelUnderTest, report: Report) -> None:
    observer = model.pool.observer
    full = observer.ground_truth("val_0")
    observer._ground_truths["val_0"] = full._replace(truth=full.truth & (np.arange(4) != 1)[:, None, None])
    try:
        found = make_protocol().evaluate(model, SCENES, report.selected)
    finally:
        observer._ground_truths["val_0"] = full
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
        ({"cell_widths": [2.0, 2.0000001]}, "cell_widths: got .*, expected each width once"),
        ({"viewpoint_sets": 0}, "viewpoint_sets: got 0"),
        ({"orientations": 0}, "orientations: got 0"),
    ],
)
def test_settings_out_of_range_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_protocol(**change)


def test_a_home_too_small_for_the_cell_width_counts_with_empty_maps(
    model: ModelUnderTest, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = Viewpoints(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    monkeypatch.setattr(trials, "sparse_viewpoints", lambda *_: nothing)
    found = make_protocol(cell_widths=[9.0]).evaluate(model, SCENES, report.selected)
    for counts in found.counts.values():
        assert (counts[..., :2] == 0).all()
        assert (counts[..., 2] > 0).all()
    assert [len(distances) for distances in found.snap_distances] == [0] * 4


def test_tables_can_be_recounted_from_the_saved_maps(
    model: ModelUnderTest, report: Report, tmp_path: Path
) -> None:
    """With numpy alone, from the files alone."""
    protocol = make_protocol()
    found = protocol.evaluate(
        model, SCENES, report.selected, save=lambda maps: saved_maps.save(tmp_path, maps)
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
    assert len(found.counts) == len(totals) == 6 * 2 * 2
    for key, counts in found.counts.items():
        recounted = totals[key.approach, key.category, f"{key.cell_width:g}"].tolist()
        correct, false, truth = recounted[:3]
        assert counts.sum(axis=(0, 1)).tolist() == [correct, false, truth]
        assert pooled_iou(counts) == pytest.approx(correct / (truth + false))
        assert found.seen[key].sum(axis=(0, 1)).tolist() == recounted[3:]


def test_saved_maps_are_read_as_they_were(model: ModelUnderTest, report: Report, tmp_path: Path) -> None:
    kept: list[saved_maps.SavedMaps] = []
    make_protocol(cell_widths=[1.0]).evaluate(model, SCENES[:1], report.selected, save=kept.append)
    for maps in kept:
        saved_maps.save(tmp_path, maps)
        path = saved_maps.path_of(tmp_path, maps.trial)
        before = path.read_bytes()
        again = saved_maps.load(path)
        assert again.trial == maps.trial and again.grid == maps.grid and again.approaches == maps.approaches
        assert (again.predicted == maps.predicted).all() and (again.truth == maps.truth).all()
        saved_maps.save(tmp_path, again)
        assert path.read_bytes() == before
        # cropping keeps the world positions of the ground-truth cells
        scene = model.pool.observer.ground_truth(maps.trial.scene)
        points = maps.grid.to_points(np.argwhere(maps.truth[0]))
        row, column = scene.grid.to_cells(points).T
        assert scene.truth[0][row, column].all() and len(points) == scene.truth[0].sum()
    path.write_bytes(before[:100])
    with pytest.raises(UserError, match=r"maps .*damaged"):
        saved_maps.load(path)


def test_an_interrupted_evaluation_continues_from_the_cache(tmp_path: Path) -> None:
    protocol, model = make_protocol(cell_widths=[1.5]), make_model(tmp_path)

    class Stops(Perfect):
        calls = 0

        def __call__(self, views, wanted):
            Stops.calls += 1
            if Stops.calls == 3:
                raise KeyboardInterrupt
            return super().__call__(views, wanted)

    stops = model._replace(predict=Stops(model.setting.layers))
    with pytest.raises(KeyboardInterrupt):
        protocol.select_thresholds(stops, SCENES)
    selected = protocol.select_thresholds(stops, SCENES)
    assert Stops.calls == 3 + 2  # the trials of the second scene; those of the first are cached
    assert selected == protocol.select_thresholds(model, SCENES)
    assert selected == protocol.select_thresholds(model._replace(keep=False), SCENES)
    other = model._replace(predict=Stops(model.setting.layers, fingerprint="others"))
    protocol.select_thresholds(other, SCENES)
    assert Stops.calls == 3 + 2 + 4  # other networks, other results


def test_workers_change_nothing(
    model: ModelUnderTest, report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "_render", lambda *_: pytest.fail("rendered in the main process as well"))
    several = make_model(tmp_path, workers=2)
    protocol = make_protocol(cell_widths=[1.0])
    try:
        found = protocol.evaluate(several, SCENES, report.selected)
    finally:
        several.pool.close()
    for key, counts in found.counts.items():
        assert (counts == report.counts[key]).all() and (found.shuffled[key] == report.shuffled[key]).all()


def test_approaches_that_lack_their_network_are_left_out_unless_asked_for() -> None:
    protocol = make_protocol()
    assert list(protocol.available({"maps"}).approaches) == [
        "seg_gt", "imagination_seen", "seen_dilated", "imagination", "oracle",
    ]  # fmt: skip
    assert list(protocol.available({"images"}).approaches) == ["seg_gt", "seg_hrnet", "oracle"]
    some = make_protocol(only=["imagination", "seg_gt"])
    assert list(some.available({"maps"}).approaches) == ["imagination", "seg_gt"]
    with pytest.raises(UserError, match=r"evaluation\.only: got seg_hrnet.*segmentation network"):
        make_protocol(only=["seg_gt", "seg_hrnet"]).available({"maps"})
    with pytest.raises(UserError, match=r"evaluation\.only: got 'seg_gd'.*imagination, "):
        make_protocol(only=["seg_gd"]).available({"maps"})


def test_maps_of_scenes_with_any_name_are_saved(
    model: ModelUnderTest, report: Report, tmp_path: Path
) -> None:
    kept: list[saved_maps.SavedMaps] = []
    protocol = make_protocol(cell_widths=[1.0], viewpoint_sets=1)
    protocol.evaluate(model, SCENES[:1], report.selected, save=kept.append)
    names = ["/scans/a.glb", "scans_a.glb", "/scans/a glb", "../a", "a_1m_0", "a"]
    for name in names:
        saved_maps.save(tmp_path, kept[0]._replace(trial=Trial(name, 1.0, 0)))
    paths = list((tmp_path / "maps").iterdir())
    assert sorted(saved_maps.load(path).trial.scene for path in paths) == sorted(names)
    assert saved_maps.path_of(tmp_path, Trial("test_0003", 2.5, 0)).name == "test_0003_2.5m_0.npz"


def test_the_order_of_approaches_and_categories_does_not_swap_results(
    model: ModelUnderTest, report: Report, tmp_path: Path
) -> None:
    protocol = make_protocol(cell_widths=[1.0])
    order = list(reversed(protocol.approaches))
    found = replace(protocol, approaches={name: protocol.approaches[name] for name in order}).evaluate(
        model, SCENES, report.selected
    )
    for key, counts in found.counts.items():
        assert (counts == report.counts[key]).all()
    observer = model.pool.observer
    reordered = replace(observer, categories=CategoryTable(observer.categories.rows[::-1]))
    assert (reordered.ground_truth("val_0").truth == observer.ground_truth("val_0").truth[::-1]).all()
