"""Projection, registration and the mapper's whole step, beside copies of memory and the ways of public systems.

Everything on one thread. Each rival's result is compared with ours before anything is timed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32

from benchmarks.measure import Figure, copying, medians
from benchmarks.rivals import PaddedRegistration, SplattedMapping
from benchmarks.subjects import SEED, camera, home, poses
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, project_categories, project_depth
from imagination.mapping.mapper import Mapper
from imagination.mapping.module import Description, Observation
from imagination.mapping.registration import Max, MovingAverage
from imagination.mapping.semantic import SemanticMapper
from imagination.scenes.renderer import Renderer

NAMES = ["chair", "bed", "table"]
EGO = EgoGrid(0.02, 261)
LENS = camera(256)
ROOM, OBSTACLES = Band(0.0, 2.6), Band(0.2, 1.5)
RESOLUTION = 0.02
HEIGHTS = int(ROOM.high / 0.05)
"""Voxels of SemExp's 5 cm over the height of a room."""


def run(_: str) -> list[Figure]:
    """All figures."""
    torch.set_num_threads(1)
    check_padded()
    check_splatted()
    depth, labels = a_view()
    figures = [projection(depth, labels)]
    figures += registration()
    figures.append(whole_step(depth, labels))
    figures.append(frame(depth))
    return figures


def a_view() -> tuple[Float32[np.ndarray, "h w"], np.ndarray]:
    """Depth of a home and a category for each pixel: of some random views, the one with most pixels of a category."""
    scene = home()
    renderer = Renderer(scene.mesh, scene.lighting)
    lookup = scene.category_of_instance(NAMES)
    views = []
    for pose in poses(scene, 20):
        image = renderer.render(LENS, LENS.to_world(pose, scene.floor_height))
        labels = np.where(image.instance < 0, np.uint8(0), lookup[np.maximum(image.instance, 0)])
        views.append((image.depth, labels))
    return max(views, key=lambda view: int((view[1] > 0).sum()))


def grid_of(cells: int) -> Grid:
    """A square global map."""
    return Grid.centred((cells - 0.5) * RESOLUTION, RESOLUTION)


def statement(seed: int = SEED) -> tuple[Float32[np.ndarray, "c v v"], Bool[np.ndarray, "c v v"]]:
    """Probabilities, and a mask of three quarters of the cells: the wedge that a camera of 90 degrees can see."""
    values = np.random.default_rng(seed).random((len(NAMES), EGO.cells, EGO.cells), np.float32)
    rows, columns = np.indices((EGO.cells, EGO.cells))
    wedge = np.abs(columns - EGO.cells // 2) <= EGO.cells - 1 - rows
    return values, np.repeat(wedge[None], len(NAMES), axis=0)


def places(count: int) -> list[Pose]:
    """Random poses about the middle of the map, at random headings."""
    rng = np.random.default_rng(SEED)
    return [Pose(*rng.uniform((-1, -1, -np.pi), (1, 1, np.pi)).tolist()) for _ in range(count)]


def check_padded(cells: int = 1001, views: int = 12) -> None:
    """The padded registration's map is ours: masks differ where a cell's centre lies on an edge, values by rounding."""
    values, mask = statement()
    ours = Mapper(grid_of(cells), EGO, NAMES, MovingAverage(0.9))
    rival = PaddedRegistration(grid_of(cells), EGO, len(NAMES), 0.9)
    for pose in places(views):
        ours.register(values, mask, pose)
        rival.register(torch.from_numpy(values)[None], torch.from_numpy(mask)[None], pose)
    theirs, written = rival.map[0].numpy(), rival.written[0].numpy()
    both = written & ours.written
    assert both.sum() > 0.999 * (written | ours.written).sum(), "they write other cells"
    assert np.mean(np.abs(theirs - ours.probabilities)[both] < 2e-3) > 0.999, "they hold other values"


def check_splatted() -> None:
    """Where points lie on cells' centres and the robot looks along a column, no weight is shared: the map is ours."""
    depth, labels = a_view()
    flat = np.zeros((LENS.height * LENS.width, 3), np.float32)
    cells = points_in_cells(depth, LENS)
    flat[:, :2], flat[:, 2] = np.round(cells[:, :2]), np.clip(np.round(cells[:, 2]), 0, HEIGHTS - 1)
    hot = one_hot(depth, labels, cells)
    marked = project_categories(depth, labels, LENS, EGO, len(NAMES), ROOM)
    pose = Pose(10 * RESOLUTION, -7 * RESOLUTION, np.pi / 2)
    rival = SplattedMapping(grid_of(1001), EGO, len(NAMES), HEIGHTS)
    rival.register(torch.from_numpy(flat), hot, pose)
    ours = Mapper(grid_of(1001), EGO, NAMES, Max())
    ours.register(marked.astype(np.float32), np.ones_like(marked), pose)
    # bilinear weights of whole cells are 0 or 1 but for rounding
    differing = np.abs(rival.map[0].numpy() - ours.probabilities) > 1e-2
    assert marked.any() and differing.sum() <= 1e-3 * marked.sum() + 1, "the splatted map is another"


def points_in_cells(depth: Float32[np.ndarray, "h w"], lens: Camera) -> Float32[np.ndarray, "n 3"]:
    """Row, column and height of each pixel's return, in cells of the egocentric grid and voxels of 5 cm."""
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    centre_u, centre_v = lens.principal_point
    optical = np.stack(
        [(u - centre_u) / lens.focal_length * depth, (v - centre_v) / lens.focal_length * depth, depth],
        axis=-1,
    ).reshape(-1, 3)
    to_robot = lens.to_robot()
    robot = optical @ to_robot[:3, :3].T + to_robot[:3, 3]
    row = EGO.cells - 1 - robot[:, 0] / EGO.resolution
    column = EGO.cells // 2 - robot[:, 1] / EGO.resolution
    return np.stack([row, column, robot[:, 2] / 0.05], axis=1).astype(np.float32)


def one_hot(
    depth: Float32[np.ndarray, "h w"], labels: np.ndarray, cells: Float32[np.ndarray, "n 3"]
) -> torch.Tensor:
    """Categories of the returns between floor and ceiling, one column each."""
    height = cells[:, 2] * 0.05
    counts = (depth.reshape(-1) > 0) & (height >= ROOM.low) & (height <= ROOM.high)
    hot = (labels.reshape(-1)[:, None] == np.arange(1, len(NAMES) + 1)) & counts[:, None]
    return torch.from_numpy(hot.astype(np.float32))


def projection(depth: Float32[np.ndarray, "h w"], labels: np.ndarray) -> Figure:
    """Occupancy, seen area and three categories of one view."""

    def ours() -> None:
        project_depth(depth, LENS, EGO, OBSTACLES)
        project_categories(depth, labels, LENS, EGO, len(NAMES), ROOM)

    maps = np.zeros((2 + len(NAMES), EGO.cells, EGO.cells), bool)
    times = medians({"ours": ours, "copy": copying(depth, labels, maps)}, 2.0)
    what = "projection 256² depth to 261² occupied, seen and 3 categories"
    return Figure(
        what,
        1e3 * times["ours"],
        "ms",
        1e3 * times["copy"],
        "copying its input and output",
        3.0,
        at_most=True,
    )


def registration() -> list[Figure]:
    """One view into maps of several sizes; the padded way beside it, whose cost grows with the map."""
    values, mask = statement()
    sizes = (501, 1001, 2001, 4001, 8001)
    ours = {cells: _registering(cells, values, mask) for cells in sizes}
    window = np.zeros(int(mask.sum()), np.float32)
    # values and mask are read, map and count of the cells touched are read and written
    touched = copying(values, mask, window, window, window, window)
    times = medians({**{str(cells): step for cells, step in ours.items()}, "copy": touched}, 10.0)
    figures = []
    for cells in sizes:
        what = (
            f"registration 261² to {cells}², 3 categories, moving average, bilinear, random headings, "
            f"{mask.mean():.0%} of the cells said"
        )
        limit = 1e3 * times["copy"], "copying the cells touched"
        asked = 3.0 if cells == 2001 else None
        figures.append(Figure(what, 1e3 * times[str(cells)], "ms", *limit, asked, at_most=True))
        if cells <= 4001:  # at 8001 one view of theirs takes 5 GB
            rival = PaddedRegistration(grid_of(cells), EGO, len(NAMES), 0.9)
            tensors = torch.from_numpy(values)[None], torch.from_numpy(mask)[None]
            theirs = partial(_register, rival, tensors, cycle(places(64)))
            pair = medians({"ours": ours[cells], "theirs": theirs}, 1.0, 3)
            beside = "OccupancyAnticipation's way, same result"
            theirs_ms, emptied = 1e3 * pair["theirs"], "in turns with theirs, which empties the caches"
            figures.append(
                Figure(what, 1e3 * pair["ours"], "ms", theirs_ms, beside, rival=True, note=emptied)
            )
    spread = times["8001"] / times["2001"]
    figures.append(
        Figure("registration at 8001² over that at 2001²", spread, "times", target=1.2, at_most=True)
    )
    return figures


def _registering(
    cells: int, values: Float32[np.ndarray, "c v v"], mask: Bool[np.ndarray, "c v v"]
) -> Callable[[], None]:
    """Registers a view into a map of that size, whose pages are there before the clock runs."""
    mapper = Mapper(grid_of(cells), EGO, NAMES, MovingAverage(0.9))
    for pose in places(64):
        mapper.register(values, mask, pose)
    return partial(_register, mapper, (values, mask), cycle(places(64)))


def _register(mapper: Any, statement: tuple[Any, Any], steps: Iterator[Pose]) -> None:
    mapper.register(*statement, next(steps))


def whole_step(depth: Float32[np.ndarray, "h w"], labels: np.ndarray) -> Figure:
    """Projection of a segmented view and its registration, beside splatting and two samplings of the full map."""
    grid = grid_of(2001)
    mapper = Mapper(grid, EGO, NAMES, Max())
    rival = SplattedMapping(grid, EGO, len(NAMES), HEIGHTS)
    steps = cycle(places(64))

    def ours(pose: Pose) -> None:
        found = project_categories(depth, labels, LENS, EGO, len(NAMES), ROOM)
        seen = project_depth(depth, LENS, EGO, OBSTACLES).seen
        mapper.register(found.astype(np.float32), found | seen, pose)

    def theirs(pose: Pose) -> None:
        cells = points_in_cells(depth, LENS)
        rival.register(torch.from_numpy(cells), one_hot(depth, labels, cells), pose)

    times = medians(
        {
            name: partial(lambda step: step(next(steps)), step)
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
        "SemExp's way",
        rival=True,
        note="the same result where points lie on cells' centres and the heading along a column; elsewhere theirs "
        "shares points out and blurs twice; no limit beside it, as copying its few bytes says nothing: those of its "
        "parts stand with projection and registration",
    )


class Answering:
    """An imagination module that answers at once: what is left is the mapper's own."""

    def __init__(self) -> None:
        colours = tuple((0, 0, 0) for _ in NAMES)
        self.description = Description(tuple(NAMES), colours, (0.5,) * len(NAMES), LENS, EGO, OBSTACLES)
        self.answer, _ = statement()

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        return self.answer


def frame(depth: Float32[np.ndarray, "h w"]) -> Figure:
    """All that a robot's mapper does with a frame but the network: projection, M*_seen, registration, bookkeeping."""
    mapper, steps = SemanticMapper(Answering(), grid=grid_of(2001)), cycle(places(64))
    rgb, cells = (
        np.zeros((*depth.shape, 3), np.uint8),
        np.zeros((len(NAMES) + 1, EGO.cells, EGO.cells), np.float32),
    )
    times = medians(
        {"update": lambda: mapper.update(rgb, depth, next(steps)), "copy": copying(rgb, depth, cells, cells)},
        3.0,
    )
    return Figure(
        "`SemanticMapper.update` without the network: 256² frame into a 2001² map of 3 categories and occupancy",
        1e3 * times["update"],
        "ms",
        1e3 * times["copy"],
        "copying the frame and its maps",
    )
