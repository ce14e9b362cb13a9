"""Projection, registration and the whole step of the mapper, relative to memory copies and methods of public systems.

All functions run on one thread. The result of each public method is compared with ours before timing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32

from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, project_categories, project_depth
from imagination.mapping.mapper import Mapper
from imagination.mapping.predictor import Observation, UnitSpec
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.mapping.update_rules import Max, MovingAverage
from imagination.scenes.renderer import Renderer
from tests.benchmarks.measure import Figure, copying, medians
from tests.benchmarks.rivals import VOXEL, PaddedRegistration, SplattedMapping, categories_of, points_in_cells
from tests.benchmarks.subjects import SEED, camera, poses, procedural_scene

NAMES = ["chair", "bed", "table"]
EGO = EgoGrid(0.02, 261)
LENS = camera(256)
ROOM, OBSTACLES = Band(0.0, 2.6), Band(0.2, 1.5)
RESOLUTION = 0.02
HEIGHTS = int(ROOM.high / VOXEL)
"""Number of SemExp's voxels over the height of a room."""

WARM = (
    "64 poses in turn, spread over the part of the map that contains the whole view (at 501² all in the middle); the "
    "values of the view stay in the CPU caches"
)


def run(_: str) -> list[Figure]:
    """Return all figures."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    check_padded()
    check_splatted()
    depth, labels = example_view()
    figures = [projection(depth, labels)]
    figures += registration()
    figures.append(whole_step(depth, labels))
    figures.append(frame(depth))
    return figures


def example_view() -> tuple[Float32[np.ndarray, "h w"], np.ndarray]:
    """Return depth and categories of the random view with most pixels of a category."""
    scene = procedural_scene()
    renderer = Renderer(scene.mesh, scene.lighting)
    lookup = scene.category_of_instance(NAMES)
    views = []
    for pose in poses(scene, 20):
        image = renderer.render(LENS, LENS.to_world(pose, scene.floor_height))
        labels = np.where(image.instance < 0, np.uint8(0), lookup[np.maximum(image.instance, 0)])
        views.append((image.depth, labels))
    return max(views, key=lambda view: int((view[1] > 0).sum()))


def grid_of(cells: int) -> Grid:
    """Return a square global map."""
    return Grid.centred((cells - 0.5) * RESOLUTION, RESOLUTION)


def view_evidence(seed: int = SEED) -> tuple[Float32[np.ndarray, "c v v"], Bool[np.ndarray, "c v v"]]:
    """Return probabilities, and a mask of three quarters of the cells: the field of view of a 90-degree camera."""
    values = np.random.default_rng(seed).random((len(NAMES), EGO.cells, EGO.cells), np.float32)
    rows, columns = np.indices((EGO.cells, EGO.cells))
    wedge = np.abs(columns - EGO.cells // 2) <= EGO.cells - 1 - rows
    return values, np.repeat(wedge[None], len(NAMES), axis=0)


def spread_poses(count: int, cells: int) -> list[Pose]:
    """Return random poses over the part of the map that contains the whole view."""
    rng = np.random.default_rng(SEED)
    reach = EGO.cells * RESOLUTION * np.hypot(1.0, 0.5)  # distance of the corners of a view
    limit = max(0.0, cells * RESOLUTION / 2 - reach)
    return [
        Pose(*rng.uniform((-limit, -limit, -np.pi), (limit, limit, np.pi)).tolist()) for _ in range(count)
    ]


def check_padded(cells: int = 1001, views: int = 12) -> None:
    """Check that the padded registration gives our map, up to rounding and cells whose centre is on an edge."""
    values, mask = view_evidence()
    ours = Mapper(grid_of(cells), EGO, NAMES, MovingAverage(0.9))
    rival = PaddedRegistration(grid_of(cells), EGO, len(NAMES), 0.9)
    for pose in spread_poses(views, cells):
        ours.register(values, mask, pose)
        rival.register(torch.from_numpy(values)[None], torch.from_numpy(mask)[None], pose)
    theirs, written = rival.map[0].numpy(), rival.written[0].numpy()
    common = written & ours.written
    assert common.sum() > 0.999 * (written | ours.written).sum(), "the maps have different cells"
    assert np.mean(np.abs(theirs - ours.probabilities)[common] < 2e-3) > 0.999, (
        "the maps have different values"
    )


def check_splatted() -> None:
    """Check that splatting gives our map if points are on cell centres and the robot faces along a column."""
    depth, labels = example_view()
    projected = project_categories(depth, labels, LENS, EGO, len(NAMES), ROOM)
    pose = Pose(10 * RESOLUTION, -7 * RESOLUTION, np.pi / 2)
    rival = SplattedMapping(grid_of(1001), EGO, len(NAMES), HEIGHTS)
    points, categories = splat_inputs(torch.from_numpy(depth), torch.from_numpy(labels))
    rival.register(points.round().clamp(max=torch.tensor([np.inf, np.inf, HEIGHTS - 1])), categories, pose)
    ours = Mapper(grid_of(1001), EGO, NAMES, Max())
    ours.register(projected.astype(np.float32), np.ones_like(projected), pose)
    # bilinear weights of whole cells are 0 or 1 up to rounding
    differing = np.abs(rival.map[0].numpy() - ours.probabilities) > 1e-2
    assert projected.any() and differing.sum() <= 1e-3 * projected.sum() + 1, "the maps differ"


def splat_inputs(depth: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the points of a view and their categories, the inputs of SemExp's method."""
    points = points_in_cells(depth, LENS, EGO)
    return points, categories_of(points, depth, labels, len(NAMES), ROOM)


def projection(depth: Float32[np.ndarray, "h w"], labels: np.ndarray) -> Figure:
    """Measure the projection of occupancy, seen area and three categories of one view."""

    def ours() -> None:
        project_depth(depth, LENS, EGO, OBSTACLES)
        project_categories(depth, labels, LENS, EGO, len(NAMES), ROOM)

    maps = np.zeros((2 + len(NAMES), EGO.cells, EGO.cells), bool)
    times = medians({"ours": ours, "copy": copying(depth, labels, maps)}, 2.0)
    return Figure(
        "projection 256² depth to 261² occupied, seen and 3 categories",
        1e3 * times["ours"],
        "ms",
        1e3 * times["copy"],
        "copying its input and output",
        3.0,
        at_most=True,
    )


def registration() -> list[Figure]:
    """Measure the registration of a view into maps of several sizes, ours and the padded method."""
    values, mask = view_evidence()
    sizes = (501, 1001, 2001, 4001, 8001)
    ours = {cells: _registering(cells, values, mask) for cells in sizes}
    window = np.zeros(int(mask.sum()), np.float32)
    # values and mask are read; map and count of the updated cells are read and written
    updated = copying(values, mask, window, window, window, window)
    times = medians({**{str(cells): step for cells, step in ours.items()}, "copy": updated}, 10.0)
    figures = []
    for cells in sizes:
        what = (
            f"registration 261² to {cells}², 3 categories, moving average, bilinear, random headings, "
            f"{mask.mean():.0%} of the cells observed"
        )
        limit = 1e3 * times["copy"], "copying the updated cells"
        target = 3.0 if cells == 2001 else None
        figures.append(Figure(what, 1e3 * times[str(cells)], "ms", *limit, target, at_most=True, note=WARM))
        if cells <= 4001:  # at 8001 the padded method needs 5 GB for one view
            rival = PaddedRegistration(grid_of(cells), EGO, len(NAMES), 0.9)
            tensors = torch.from_numpy(values)[None], torch.from_numpy(mask)[None]
            theirs = partial(_register, rival, tensors, cycle(spread_poses(64, cells)))
            pair = medians({"ours": ours[cells], "theirs": theirs}, 1.0, 3)
            reference = "OccupancyAnticipation's method, same result"
            reference_ms, note = 1e3 * pair["theirs"], "alternating with theirs, which evicts the CPU caches"
            figures.append(
                Figure(what, 1e3 * pair["ours"], "ms", reference_ms, reference, rival=True, note=note)
            )
    ratio = times["8001"] / times["2001"]
    figures.append(
        Figure("registration at 8001² over that at 2001²", ratio, "times", target=1.2, at_most=True)
    )
    return figures


def _registering(
    cells: int, values: Float32[np.ndarray, "c v v"], mask: Bool[np.ndarray, "c v v"]
) -> Callable[[], None]:
    """Return a function that registers a view into a map whose memory pages are allocated."""
    mapper = Mapper(grid_of(cells), EGO, NAMES, MovingAverage(0.9))
    for pose in spread_poses(64, cells):
        mapper.register(values, mask, pose)
    return partial(_register, mapper, (values, mask), cycle(spread_poses(64, cells)))


def _register(mapper: Any, evidence: tuple[Any, Any], poses: Iterator[Pose]) -> None:
    mapper.register(*evidence, next(poses))


def whole_step(depth: Float32[np.ndarray, "h w"], labels: np.ndarray) -> Figure:
    """Measure projection and registration of a segmented view, ours and SemExp's splatting and resampling."""
    grid = grid_of(2001)
    mapper = Mapper(grid, EGO, NAMES, Max())
    rival = SplattedMapping(grid, EGO, len(NAMES), HEIGHTS)
    poses = cycle(spread_poses(64, 2001))
    tensors = torch.from_numpy(depth), torch.from_numpy(labels)

    def ours(pose: Pose) -> None:
        projected = project_categories(depth, labels, LENS, EGO, len(NAMES), ROOM)
        seen = project_depth(depth, LENS, EGO, OBSTACLES).seen
        mapper.register(projected.astype(np.float32), projected | seen, pose)

    def theirs(pose: Pose) -> None:
        rival.register(*splat_inputs(*tensors), pose)

    times = medians(
        {
            name: partial(lambda step: step(next(poses)), step)
            for name, step in (("ours", ours), ("theirs", theirs))
        },
        3.0,
        3,
    )
    return Figure(
        "mapper's whole step: segmented 256² view into a 2001² map of 3 categories",
        1e3 * times["ours"],
        "ms",
        1e3 * times["theirs"],
        "SemExp's method",
        rival=True,
        note="the same result if points are on cell centres and the heading is along a column; elsewhere SemExp "
        "distributes points over cells and blurs twice; for limits see projection and registration",
    )


class ConstantModule:
    """Imagination module with a constant prediction, so that only the mapper is measured."""

    def __init__(self) -> None:
        colours = tuple((0, 0, 0) for _ in NAMES)
        self.spec = UnitSpec(tuple(NAMES), colours, (0.5,) * len(NAMES), LENS, EGO, OBSTACLES)
        self.prediction, _ = view_evidence()

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        return self.prediction


def frame(depth: Float32[np.ndarray, "h w"]) -> Figure:
    """Measure the update of a robot's mapper without the network: projection, M*_seen and registration."""
    mapper, poses = SemanticMapper(ConstantModule(), grid=grid_of(2001)), cycle(spread_poses(64, 2001))
    rgb, cells = (
        np.zeros((*depth.shape, 3), np.uint8),
        np.zeros((len(NAMES) + 1, EGO.cells, EGO.cells), np.float32),
    )
    times = medians(
        {"update": lambda: mapper.update(rgb, depth, next(poses)), "copy": copying(rgb, depth, cells, cells)},
        3.0,
    )
    return Figure(
        "`SemanticMapper.update` without the network: 256² frame into a 2001² map of 3 categories and occupancy",
        1e3 * times["update"],
        "ms",
        1e3 * times["copy"],
        "copying the frame and its maps",
    )
