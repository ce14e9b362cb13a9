"""Evidence of each approach for a view, against masks computed by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from imagination.evaluation.approaches import (
    Approach,
    ImaginableArea,
    ProjectedSegmentation,
    SeenPrediction,
    Setting,
    ValidPrediction,
)
from imagination.evaluation.global_maps import area_of, score_maps
from imagination.evaluation.metrics import count
from imagination.geometry.camera import Camera
from imagination.geometry.crop import crop
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.morphology import close, dilate
from imagination.geometry.pose import Pose
from imagination.ground_truth.scene_maps import GroundTruth
from imagination.mapping.update_rules import Max, MovingAverage
from imagination.utils.errors import UserError

CAMERA = Camera(16, 16, np.pi / 2, 1.25)
EGO = EgoGrid(0.1, 9)
SETTING = Setting(CAMERA, EGO, [1], ["bed"], 3)


def one_view(seen: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "pose": np.array([[0.0, 0.0, np.pi / 2]]),
        "depth": np.zeros((1, 16, 16), np.float16),
        "categories": np.zeros((1, 16, 16), np.uint8),
        "seen": seen[None],
    }


def seen_square() -> np.ndarray:
    seen = np.zeros((9, 9), bool)
    seen[2:6, 2:6] = True
    return seen


def test_seen_prediction_writes_the_cells_it_saw() -> None:
    probabilities = np.full((1, 1, 9, 9), 0.7, np.float32)
    values, mask, _ = SeenPrediction()(one_view(seen_square()), {"maps": probabilities}, SETTING)
    assert (mask[0, 0] == seen_square()).all()
    assert (values[mask] == np.float32(0.7)).all()


def test_valid_prediction_writes_what_it_saw_and_the_neighbourhood() -> None:
    probabilities = np.full((1, 1, 9, 9), 0.4, np.float32)
    probabilities[0, 0, 4, 5] = 0.5  # seen, and as sure as tau_valid asks
    probabilities[0, 0, 8, 8] = 0.9  # sure, but far from anything seen of an object
    values, mask, _ = ValidPrediction(0.5, 0.3)(one_view(seen_square()), {"maps": probabilities}, SETTING)
    near = np.zeros((9, 9), bool)
    near[3:6, 4:7] = True
    assert (mask[0, 0] == seen_square() | near).all()
    assert (values[0, 0] == np.where(near, probabilities[0, 0], 0)).all()


def test_a_view_that_sees_no_object_denies_what_it_saw() -> None:
    probabilities = np.full((1, 1, 9, 9), 0.49, np.float32)
    values, mask, _ = ValidPrediction(0.5, 0.3)(one_view(seen_square()), {"maps": probabilities}, SETTING)
    assert (mask[0, 0] == seen_square()).all()
    assert not values.any()


def test_segmentation_writes_returns_of_its_category_and_what_it_saw() -> None:
    view = one_view(seen_square())
    view["depth"][0, 8, 8], view["categories"][0, 8, 8] = 0.5, 2  # straight ahead: 0.5 m
    view["depth"][0, 8, 2], view["categories"][0, 8, 2] = 0.5, 1  # of another category
    values, mask, _ = ProjectedSegmentation(0.0, 2.0, np.inf)(view, {}, SETTING)
    assert np.argwhere(values[0, 0]).tolist() == [[3, 4]]
    assert (mask[0, 0] == seen_square() | (values[0, 0] > 0)).all()


@pytest.mark.parametrize(
    ("low", "high", "max_range"), [(1.5, 2.0, np.inf), (0.0, 1.0, np.inf), (0.0, 2.0, 0.4)]
)
def test_segmentation_leaves_out_what_lies_beyond_its_band_or_range(
    low: float, high: float, max_range: float
) -> None:
    view = one_view(seen_square())
    view["depth"][0, 8, 8], view["categories"][0, 8, 8] = 0.5, 2
    values, *_ = ProjectedSegmentation(low, high, max_range)(view, {}, SETTING)
    assert not values.any()


@settings(max_examples=40)
@given(
    arrays(np.float32, (8, 8), elements=st.floats(0, 1, width=32)),
    st.floats(0.0625, 1, width=32),
    st.sampled_from([0.0, 0.1, 0.2, 0.3, 0.4]),
)
def test_finishing_the_score_is_finishing_the_thresholded_map(
    score: np.ndarray, threshold: float, kernel: float
) -> None:
    thresholded, truth = score >= threshold, score[::-1] >= 0.5
    cells = max(1, round(kernel / 0.1))
    for postprocess, expected in (
        ("none", thresholded),
        ("close", close(thresholded, cells)),
        ("dilate", dilate(thresholded, cells)),
        ("ground_truth", thresholded & truth),
    ):
        approach = Approach(SeenPrediction(), Max(), postprocess, (kernel,))
        assert ((approach.apply_postprocess(score, truth, kernel, 0.1) >= threshold) == expected).all()


def test_a_perfect_prediction_gives_a_perfect_map() -> None:
    """Views on whole cells that look up the map, so that registration interpolates nothing."""
    rng = np.random.default_rng(0)
    grid = Grid.centred(4.1, 0.1)
    truth = np.zeros((3, *grid.shape), bool)
    truth[1, 10:14, 12:20] = truth[1, 25:30, 25:28] = True
    maps = GroundTruth(grid, truth.any(axis=0), truth, truth, truth, np.zeros((1, 2)))
    cells = np.stack(np.meshgrid(np.arange(8, 41, 4), np.arange(4, 37, 4)), axis=-1).reshape(-1, 2)
    poses = [Pose(float(x), float(y), np.pi / 2) for x, y in grid.to_points(rng.permutation(cells))]
    views = {
        "pose": np.array(poses),
        "seen": np.ones((len(poses), 9, 9), bool),
    }
    probabilities = np.stack([crop(truth[1:2], grid, pose, EGO) for pose in poses]).astype(np.float32)
    approaches = {"imagination": Approach(ValidPrediction(0.5, 0.3), MovingAverage(0.9))}
    area = area_of(maps, [1], views["pose"], EGO, 0.0)
    scores = score_maps(views, {"maps": probabilities}, approaches, SETTING, area.grid, np.arange(len(poses)))
    assert count(scores["imagination"][0] >= 0.5, area.truth[0]).tolist() == [47, 0, 47]


def test_cropping_to_the_reach_of_views_changes_no_count() -> None:
    rng = np.random.default_rng(1)
    grid = Grid.centred(6.1, 0.1)
    truth = np.zeros((3, *grid.shape), bool)
    truth[1, 5:9, 50:58] = True  # far from the views, still part of the scene
    maps = GroundTruth(grid, truth.any(axis=0), truth, truth, truth, np.zeros((1, 2)))
    views = {"pose": np.array([[-1.03, -1.2, 0.4], [-0.6, -1.5, 2.0]]), "seen": rng.random((2, 9, 9)) < 0.8}
    probabilities = rng.random((2, 1, 9, 9)).astype(np.float32)
    approaches = {"seen_dilated": Approach(SeenPrediction(), MovingAverage(0.9), "dilate", (0.3,))}
    area = area_of(maps, [1], views["pose"], EGO, 0.3)
    assert area.grid.rows < grid.rows

    def counted(where: Grid, layer: np.ndarray) -> list[int]:
        score = score_maps(views, {"maps": probabilities}, approaches, SETTING, where, np.arange(2))[
            "seen_dilated"
        ][0]
        apply_postprocess = approaches["seen_dilated"].apply_postprocess(score, layer, 0.3, 0.1)
        return [int(x) for x in count(apply_postprocess >= 0.5, layer)]

    assert counted(area.grid, area.truth[0]) == counted(grid, truth[1])


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(UserError, match=r"valid_threshold: got 1\.5"):
        ValidPrediction(1.5, 0.3)
    with pytest.raises(
        UserError, match=r"approach\.postprocess: got 'melt'.*close, dilate, ground_truth, none"
    ):
        Approach(SeenPrediction(), Max(), "melt")
    with pytest.raises(UserError, match=r"approach\.kernels: got -0\.1"):
        Approach(SeenPrediction(), Max(), "dilate", (-0.1,))


def test_a_predicted_segmentation_is_projected_in_the_truth_s_place() -> None:
    view = one_view(seen_square())
    view["depth"][0, 8, 8], view["categories"][0, 8, 8] = 0.5, 1
    images = np.zeros((1, 16, 16), np.uint8)
    images[0, 8, 8] = 2
    evidence = ProjectedSegmentation(0.0, 2.0, np.inf, predicted=True)
    values, *_ = evidence(view, {"images": images}, SETTING)
    assert np.argwhere(values[0, 0]).tolist() == [[3, 4]] and evidence.needs == "images"


def test_the_imaginable_area_surrounds_what_is_seen_of_an_object() -> None:
    view = one_view(seen_square())
    view["object"] = np.zeros((1, 3, 9, 9), bool)
    view["object"][0, 1, 5, 5:8] = True  # seen at column 5, imaginable one cell further
    values, mask, _ = ImaginableArea(0.3)(view, {}, SETTING)
    near = np.zeros((9, 9), bool)
    near[4:7, 4:7] = True
    assert (mask[0, 0] == near).all() and (values == mask).all()
