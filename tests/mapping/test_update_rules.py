import tracemalloc
from pathlib import Path

import cv2
import jaxtyping
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.mapping import mapper as mapper_module
from imagination.mapping.map_io import save_maps
from imagination.mapping.mapper import Mapper
from imagination.mapping.semantic_map import Maps
from imagination.mapping.update_rules import (
    EntropyMovingAverage,
    Latest,
    Max,
    Mean,
    MovingAverage,
    UpdateRule,
)
from imagination.utils.errors import UserError

RESOLUTION = 0.0625  # a power of two, so that shifts by whole cells are exact
GRID = Grid(RESOLUTION, 60, 70, (-2.0, -1.0))
EGO = EgoGrid(RESOLUTION, 21)
RULES = [MovingAverage(0.9), MovingAverage(0.3), Mean(), Max(), Latest(), EntropyMovingAverage(0.8, 0.4)]


def expected_value(rule: UpdateRule, values: list[float]) -> float:
    """Return the value of a cell after a sequence of writes, by the definition of each rule."""
    if isinstance(rule, Mean):
        return sum(values) / len(values)
    if isinstance(rule, Max):
        return max(values)
    if isinstance(rule, Latest):
        return values[-1]
    assert isinstance(rule, MovingAverage | EntropyMovingAverage)
    max_entropy = rule.max_entropy if isinstance(rule, EntropyMovingAverage) else 1.0
    cell = values[0]
    for value in values[1:]:
        entropy = -sum(p * np.log(p) for p in (value, 1 - value) if p > 0)
        if entropy <= max_entropy:
            cell = rule.aggregation_factor * cell + (1 - rule.aggregation_factor) * value
    return cell


def cells_by_loops(values: np.ndarray, mask: np.ndarray, pose: Pose) -> list[tuple[int, int, int, float]]:
    """Return layer, row, column and value of each global cell that a view writes."""
    last, found = EGO.cells - 1, []
    for row in range(GRID.rows):
        for column in range(GRID.columns):
            x = GRID.origin[0] + (column + 0.5) * RESOLUTION - pose.x
            y = GRID.origin[1] + (GRID.rows - row - 0.5) * RESOLUTION - pose.y
            forward = np.cos(pose.theta) * x + np.sin(pose.theta) * y
            left = np.cos(pose.theta) * y - np.sin(pose.theta) * x
            r, c = last - forward / RESOLUTION, EGO.cells // 2 - left / RESOLUTION
            if not (-0.5 <= r < last + 0.5 and -0.5 <= c < last + 0.5):
                continue
            inner_r, inner_c = np.clip(r, 0, last), np.clip(c, 0, last)
            i, j = int(inner_r), int(inner_c)
            p, q = min(i + 1, last), min(j + 1, last)
            s, t = inner_r - i, inner_c - j
            for k in range(values.shape[0]):
                if mask[k, int(np.floor(r + 0.5)), int(np.floor(c + 0.5))]:
                    upper = (1 - t) * values[k, i, j] + t * values[k, i, q]
                    lower = (1 - t) * values[k, p, j] + t * values[k, p, q]
                    found.append((k, row, column, float((1 - s) * upper + s * lower)))
    return found


def view(seed: int, layers: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return random values and a random mask of a view."""
    rng = np.random.default_rng(seed)
    values = rng.random((layers, 21, 21), dtype=np.float32)
    return values, rng.random((layers, 21, 21)) < 0.6


def on_cell(row: int, column: int, theta: float) -> Pose:
    """Return a pose at the centre of a cell of `GRID`."""
    x, y = GRID.to_points(np.array([row, column]))
    return Pose(float(x), float(y), theta)


def mapper(rule: UpdateRule, layers: int = 2) -> Mapper:
    return Mapper(GRID, EGO, ["chair", "bed", "table"][:layers], rule)


@pytest.mark.parametrize("rule", RULES, ids=repr)
def test_each_rule_agrees_with_a_loop_over_cells(rule: UpdateRule) -> None:
    poses = [
        Pose(0.11, 0.63, 0.4),
        Pose(0.31, 0.95, 2.0),
        Pose(-1.9, -0.9, 3.6),
        Pose(0.2, 0.7, 0.5),
        Pose(0.4, 0.8, -1.0),
    ]
    history: dict[tuple[int, int, int], list[float]] = {}
    global_map = mapper(rule)
    for seed, pose in enumerate(poses):
        values, mask = view(seed)
        global_map.register(values, mask, pose)
        for k, row, column, value in cells_by_loops(values, mask, pose):
            history.setdefault((k, row, column), []).append(value)
    expected = np.zeros((2, *GRID.shape))
    for cell, writes in history.items():
        expected[cell] = expected_value(rule, writes)
    written = np.zeros_like(expected, np.bool_)
    written[tuple(np.array(list(history)).T)] = True
    assert max(map(len, history.values())) >= 3
    assert np.array_equal(global_map.written, written)
    difference = np.abs(global_map.probabilities - expected)
    # entropies close to max_entropy may be on either side of it
    assert (difference > 1e-5).sum() <= (3 if isinstance(rule, EntropyMovingAverage) else 0)
    assert np.isfinite(global_map.probabilities).all()


def test_moving_average_by_hand() -> None:
    global_map, everywhere = mapper(MovingAverage(0.9), 1), np.ones((1, 21, 21), np.bool_)
    pose = on_cell(30, 30, np.pi / 2)
    cells = []
    for value in (0.8, 0.0, 1.0):
        global_map.register(np.full((1, 21, 21), value, np.float32), everywhere, pose)
        cells.append(float(global_map.probabilities[0, 30, 30]))
    assert cells == pytest.approx([0.8, 0.72, 0.748])


def test_a_view_with_heading_up_is_copied_unchanged() -> None:
    values, mask = view(0)
    global_map = mapper(Latest())
    global_map.register(values, mask, on_cell(35, 30, np.pi / 2))
    expected = np.zeros((2, *GRID.shape), np.float32)
    expected[:, 15:36, 20:41] = np.where(mask, values, 0)
    assert np.allclose(global_map.probabilities, expected, atol=1e-6)
    assert np.array_equal(global_map.written, np.pad(mask, ((0, 0), (15, 24), (20, 29))))


@pytest.mark.parametrize("turns", range(4))
def test_rotations_by_90_degrees_are_exact(turns: int) -> None:
    values, mask = view(1)
    base, turned = np.zeros((2, 2, 61, 61), np.float32)
    grid = Grid.centred(61 * RESOLUTION, RESOLUTION)
    written = []
    for out, theta in ((base, 0.0), (turned, turns * np.pi / 2)):
        global_map = Mapper(grid, EGO, ["chair", "bed"], Latest())
        global_map.register(values, mask, Pose(0.0, 0.0, theta))
        out[:] = global_map.probabilities
        written.append(global_map.written)
    assert np.array_equal(np.rot90(written[0], turns, (1, 2)), written[1])
    assert np.allclose(np.rot90(base, turns, (1, 2)), turned, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(-9, 9), st.integers(-9, 9), st.floats(-4, 4))
def test_whole_cell_shifts_are_exact(dr: int, dc: int, theta: float) -> None:
    maps = []
    # poses are at least 30 cells from every border, and a view reaches 23 cells
    for row, column in ((20, 40), (20 + dr, 40 + dc)):
        global_map = Mapper(Grid(RESOLUTION, 90, 90, (-2.0, -1.0)), EGO, ["chair", "bed"], MovingAverage())
        global_map.register(*view(2), on_cell(row, column, theta))
        maps.append((global_map.probabilities, global_map.written))
    assert np.array_equal(np.roll(maps[0][1], (dr, dc), (1, 2)), maps[1][1])
    assert np.allclose(np.roll(maps[0][0], (dr, dc), (1, 2)), maps[1][0], atol=1e-5)


@pytest.mark.parametrize("theta", np.linspace(-3, 3, 7))
def test_values_agree_with_opencvs_bilinear_warp(theta: float) -> None:
    values = cv2.GaussianBlur(np.random.default_rng(3).random((21, 21), dtype=np.float32), (5, 5), 0)
    pose = Pose(0.13, 0.87, float(theta))
    global_map = mapper(Latest(), 1)
    global_map.register(values[None], np.ones((1, 21, 21), np.bool_), pose)
    robot = GRID.rows - 0.5 - (pose.y + 1.0) / RESOLUTION, (pose.x + 2.0) / RESOLUTION - 0.5
    # OpenCV uses (column, row): up in the view is the heading in the map, right is 90 degrees clockwise from it
    right, up = (np.sin(theta), np.cos(theta)), (np.cos(theta), -np.sin(theta))
    rotation = np.array([[right[0], -up[0]], [right[1], -up[1]]])
    affine = np.column_stack([rotation, np.array(robot[::-1]) - rotation @ [10, 20]])
    warped = cv2.warpAffine(values, affine, GRID.shape[::-1], flags=cv2.INTER_LINEAR)
    inside = (
        cv2.warpAffine(np.ones((21, 21), np.float32), affine, GRID.shape[::-1], flags=cv2.INTER_LINEAR)
        > 0.999
    )
    assert inside.sum() > 300
    assert global_map.written[0][inside].all()
    assert np.abs(global_map.probabilities[0] - warped)[inside].max() < 0.01  # OpenCV rounds weights to 1/32


@pytest.mark.parametrize("theta", np.linspace(-3, 3, 9))
def test_solid_shapes_keep_their_form_under_any_rotation(theta: float) -> None:
    grid, ego, pose = Grid.centred(14.02, 0.02), EgoGrid(0.02, 261), Pose(0.217, -0.331, float(theta))

    def inside_shape(points: np.ndarray) -> np.ndarray:
        centre = pose.to_world(np.array([2.5, 0.3]))
        x, y = points[..., 0] - centre[0], points[..., 1] - centre[1]
        return (np.hypot(x, y) < 1.0) | ((np.abs(x) < 1.6) & (np.abs(y) < 0.4))

    values = inside_shape(ego.centres(pose))[None]
    global_map = Mapper(grid, ego, ["chair"], MovingAverage())
    global_map.register(values.astype(np.float32), np.ones_like(values), pose)
    got = global_map.probabilities[0] >= 0.5
    expected = inside_shape(grid.to_points(np.moveaxis(np.indices(grid.shape), 0, -1)))
    assert (got & expected).sum() / (got | expected).sum() > 0.98


@settings(max_examples=30, deadline=None)
@given(st.floats(-4, 4), st.floats(-3, 5), st.floats(-7, 7))
def test_cells_outside_the_window_do_not_change(x: float, y: float, theta: float) -> None:
    pose, global_map = Pose(x, y, theta), mapper(Latest(), 1)
    values, everywhere = np.ones((1, 21, 21), np.float32), np.ones((1, 21, 21), np.bool_)
    for row in range(5, 60, 20):
        for column in range(5, 70, 20):
            global_map.register(values * 0.25, everywhere, on_cell(row, column, 0.3))
    before, written = global_map.probabilities.copy(), global_map.written
    global_map.register(values, everywhere, pose)
    centres = GRID.to_points(np.moveaxis(np.indices(GRID.shape), 0, -1))
    forward, left = np.moveaxis(pose.to_robot(centres), -1, 0) / RESOLUTION
    inside = (forward >= -0.5 + 1e-6) & (forward <= 20.5 - 1e-6) & (np.abs(left) <= 10.5 - 1e-6)
    outside = (forward < -0.5 - 1e-6) | (forward > 20.5 + 1e-6) | (np.abs(left) > 10.5 + 1e-6)
    assert np.array_equal(global_map.probabilities[0][outside], before[0][outside])
    assert np.array_equal(global_map.written[0][outside], written[0][outside])
    assert (global_map.probabilities[0][inside] == 1).all()


def test_cells_without_evidence_do_not_change() -> None:
    global_map, (values, mask) = mapper(Latest()), view(4)
    pose = on_cell(30, 30, 0.7)
    global_map.register(values, np.zeros_like(mask), pose)
    assert not global_map.written.any()
    global_map.register(values, np.stack([mask[0], np.zeros_like(mask[0])]), pose)
    assert global_map.written[0].any()
    assert not global_map.written[1].any()


@pytest.mark.parametrize("rule", RULES, ids=repr)
def test_the_first_write_sets_the_value_even_if_it_is_zero(rule: UpdateRule) -> None:
    global_map, everywhere = mapper(rule, 1), np.ones((1, 21, 21), np.bool_)
    pose = on_cell(30, 30, 0.0)
    global_map.register(np.full((1, 21, 21), 0.375, np.float32), everywhere, pose)
    assert global_map.probabilities[0, 30, 30] == np.float32(0.375)
    global_map.reset()
    assert not global_map.written.any()
    assert not global_map.probabilities.any()
    global_map.register(np.zeros((1, 21, 21), np.float32), everywhere, pose)
    global_map.register(np.ones((1, 21, 21), np.float32), everywhere, pose)
    assert global_map.probabilities[0, 30, 30] == pytest.approx(expected_value(rule, [0.0, 1.0]))


@pytest.mark.parametrize("rule", RULES, ids=str)
@settings(max_examples=25, deadline=None)
@given(
    writes=st.lists(st.tuples(st.floats(0, 1, width=32), st.booleans()), min_size=1, max_size=8),
)
def test_the_first_observation_replaces_imagined_values(
    rule: UpdateRule, writes: list[tuple[float, bool]]
) -> None:
    global_map = mapper(rule, layers=1)
    everywhere = np.ones((1, 21, 21), bool)
    for value, imagined in writes:
        values = np.full((1, 21, 21), value, np.float32)
        global_map.register(values, everywhere, on_cell(30, 30, 0.0), everywhere if imagined else None)
    first_observation = next((index for index, (_, imagined) in enumerate(writes) if not imagined), 0)
    expected = expected_value(rule, [value for value, _ in writes[first_observation:]])
    cells = global_map.probabilities[global_map.written]
    np.testing.assert_allclose(cells, expected, atol=2e-6)
    assert global_map.written.sum() > 300


def test_views_far_outside_the_map_change_nothing() -> None:
    global_map = mapper(Latest())
    for pose in (Pose(1e300, 0.0, 0.4), Pose(-50.0, 3.0, 0.0), Pose(0.0, 60.0, 1.0)):
        global_map.register(*view(5), pose)
    assert not global_map.written.any()


@pytest.mark.parametrize("factor", [-0.1, 1.1, float("nan"), float("inf")])
def test_aggregation_factor_out_of_range_is_refused(factor: float) -> None:
    for rule in (MovingAverage, EntropyMovingAverage):
        with pytest.raises(UserError, match=r"aggregation_factor: got .*\[0.0, 1.0\]"):
            rule(factor)
    with pytest.raises(UserError, match="max_entropy: got"):
        EntropyMovingAverage(0.9, -0.1)


@pytest.mark.parametrize(
    ("values", "mask", "pose", "message"),
    [
        (
            np.zeros((2, 20, 21), np.float32),
            None,
            None,
            r"values: got float32 of shape \(2, 20, 21\)",
        ),
        (np.zeros((3, 21, 21), np.float32), None, None, "values: got"),
        (np.zeros((2, 21, 21)), None, None, "values: got float64"),
        (np.full((2, 21, 21), 1.5, np.float32), None, None, "values: got 1.5 to 1.5"),
        (np.full((2, 21, 21), -0.5, np.float32), None, None, "values: got -0.5"),
        (np.full((2, 21, 21), np.nan, np.float32), None, None, "values: got nan"),
        (None, np.ones((2, 21, 20), np.bool_), None, r"mask: got bool of shape \(2, 21, 20\)"),
        (None, None, Pose(np.nan, 0.0, 0.0), "pose: got .*(nan|inf)"),
        (None, None, Pose(0.0, 0.0, np.inf), "pose: got .*(nan|inf)"),
    ],
)
def test_invalid_views_are_refused_and_change_nothing(
    monkeypatch: pytest.MonkeyPatch,
    values: np.ndarray | None,
    mask: np.ndarray | None,
    pose: Pose | None,
    message: str,
) -> None:
    # outside the tests, jaxtyping checks no shapes
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    valid_values, valid_mask = view(6)
    global_map = mapper(MovingAverage())
    with pytest.raises(UserError, match=message):
        global_map.register(
            valid_values if values is None else values,
            valid_mask if mask is None else mask,
            pose or Pose(0.0, 0.0, 0.0),
        )
    assert not global_map.written.any()


def test_a_map_that_does_not_fit_in_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = GRID.rows * GRID.columns * (2 * 8 + 64)
    monkeypatch.setattr(mapper_module, "physical_memory", lambda: needed)
    mapper(Mean())
    monkeypatch.setattr(mapper_module, "physical_memory", lambda: needed - 1)
    with pytest.raises(UserError, match="map of 2 x 60 x 70 cells: got .* GB"):
        mapper(Mean())


def test_saving_needs_at_most_the_estimated_memory(tmp_path: Path) -> None:
    grid, layers = Grid(0.05, 600, 500, (0.0, 0.0)), 4
    global_map = Mapper(grid, EgoGrid(0.05, 21), [*"abcd"], Mean())
    maps = Maps(
        grid,
        "map",
        ("a", "b", "c"),
        (0.5, 0.5, 0.5),
        global_map.probabilities[1:],
        global_map.written[1:],
        global_map.probabilities[0],
        global_map.written[0],
    )
    tracemalloc.start()
    save_maps(tmp_path, maps, [(200, 0, 0)] * (layers - 1))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    estimate = mapper_module.SAVING_BYTES_PER_CELL * grid.rows * grid.columns
    assert 0.5 * estimate < peak < estimate


def test_views_of_another_resolution_and_maps_without_layers_are_refused() -> None:
    with pytest.raises(UserError, match="resolution: got 0.06 .*0.0625"):
        Mapper(GRID, EgoGrid(0.06, 21), ["chair"], Mean())
    with pytest.raises(UserError, match="categories: got none"):
        Mapper(GRID, EGO, [], Mean())
