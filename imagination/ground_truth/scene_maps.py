"""Ground-truth maps of a whole scene: M_gt = M_occu & M_label & M_seg (the paper's "Ground Truth Generation")."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from imagination.geometry.camera import Camera
from imagination.geometry.grid import Grid
from imagination.geometry.morphology import dilate, kernel_cells
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, splat
from imagination.scenes.categories import CategoryTable
from imagination.scenes.renderer import SceneRenderer
from imagination.scenes.scene import FreeSpace, OrientedBox, Scene, SceneObject
from imagination.utils.errors import UserError, check_range

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GroundTruthSpec:
    """Specification of the ground-truth maps.

    Attributes:
        extent: side of the map, metres.
        resolution: side of a cell, metres.
        spacing: distance between panorama points, metres.
        dilation: side of the square kernel that dilates M_seg, metres.
        obstacles: heights above the floor of obstacles (occupied cells).
        camera: camera of the panoramas; its field of view sets the number of images for 360 degrees.
    """

    extent: float
    resolution: float
    spacing: float
    dilation: float
    obstacles: Band
    camera: Camera

    def __post_init__(self) -> None:
        check_range("ground_truth.spacing", self.spacing, 0.05, 5.0, "m")
        check_range("ground_truth.dilation", self.dilation, 0.0, 5.0, "m")


class GroundTruth(NamedTuple):
    """Ground-truth maps of one scene, with layers in the order of the category table.

    Attributes:
        grid: grid of all maps, centred on the free space.
        occupied: M_occu, cells with a depth return within the obstacle heights, of walls and furniture alike.
        label: M_label, cells whose centre is inside the box of an object of the category.
        segmented: M_seg, cells with a depth return of the category at any height, dilated.
        truth: M_gt, the intersection of the three maps.
        points: world x, y of the panorama points, metres.
    """

    grid: Grid
    occupied: Bool[np.ndarray, "h w"]
    label: Bool[np.ndarray, "c h w"]
    segmented: Bool[np.ndarray, "c h w"]
    truth: Bool[np.ndarray, "c h w"]
    points: Float[np.ndarray, "n 2"]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return all fields as arrays, for files."""
        geometry = np.array([self.grid.resolution, *self.grid.origin])
        return {"resolution_and_origin": geometry, **{name: getattr(self, name) for name in self._fields[1:]}}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "GroundTruth":
        """Restore the maps from the arrays of `to_arrays`."""
        resolution, x, y = arrays["resolution_and_origin"].tolist()
        rows, columns = arrays["occupied"].shape
        return cls(Grid(resolution, rows, columns, (x, y)), *(arrays[name] for name in cls._fields[1:]))


def build(
    scene: Scene, renderer: SceneRenderer, spec: GroundTruthSpec, categories: CategoryTable
) -> GroundTruth:
    """Build the ground-truth maps of a scene for all categories of the table.

    Logs a warning for the objects of a category without a cell in M_gt, which no panorama sees within the obstacle
    heights.

    Args:
        scene: scene with its free space, from which the panoramas are rendered.
        renderer: renderer of the scene.
        spec: specification of the maps.
        categories: category table, one layer for each category.

    Raises:
        UserError: if the scene is larger than the map, or its mesh and its list of objects do not match.
    """
    _check_instances(scene)
    points = panorama_points(scene.free_space, spec.spacing)
    grid = _grid_for(scene, spec)
    occupied, returns = _render_panoramas(scene, renderer, spec, categories.names, grid, points)
    label = np.zeros_like(returns)
    for layer, name in enumerate(categories.names):
        for obj in scene.of_category(name):
            window, inside = box_cells(obj.box, grid)
            label[layer][window] |= inside
    segmented = dilate(returns, kernel_cells(spec.dilation, spec.resolution))
    gt = occupied & label & segmented
    _warn_of_missing(scene, grid, categories.names, gt)
    return GroundTruth(grid, occupied, label, segmented, gt, points)


def panorama_points(free: FreeSpace, spacing: float) -> Float[np.ndarray, "n 2"]:
    """Return the world x, y of the panorama points: one in each square of side `spacing` that contains free space.

    The point is the free cell nearest to the centre of the square, so that narrow passages have points as well.
    """
    cells = np.argwhere(free.mask)
    positions = free.grid.to_points(cells)
    offset = (positions - positions.min(axis=0)) / spacing
    square = np.floor(offset + 1e-6).astype(np.int64)
    distance = np.abs(offset - square - 0.5).max(axis=1)
    order = np.lexsort((distance, square[:, 1], square[:, 0]))
    _, first = np.unique(square[order], axis=0, return_index=True)
    return positions[order[first]]


def needed_extent(scene: Scene) -> float:
    """Return the smallest side of a map, centred on the free space, with all free space and boxes inside, metres."""
    centre, corners = _reach(scene)
    return float(2 * np.abs(corners - centre).max())


def box_cells(box: OrientedBox, grid: Grid) -> tuple[tuple[slice, slice], Bool[np.ndarray, "a b"]]:
    """Return the cells whose centre is inside the footprint of a box: a window of the grid and a mask of its cells."""
    corners = np.clip(grid.to_cells(box.footprint()), 0, np.array(grid.shape) - 1)
    (top, left), (bottom, right) = corners.min(axis=0), corners.max(axis=0)
    window = slice(top, bottom + 1), slice(left, right + 1)
    rows, columns = np.ogrid[window]
    cells = np.stack(np.broadcast_arrays(rows, columns), axis=-1)
    offset = Pose(*box.centre[:2], box.yaw).to_robot(grid.to_points(cells))
    tolerance = 1e-6  # for centres on an edge
    return window, (np.abs(offset) <= np.array(box.size[:2]) / 2 + tolerance).all(axis=-1)


def _check_instances(scene: Scene) -> None:
    """Check that `scene.objects` lists every instance of the mesh."""
    known = {0, *(obj.instance for obj in scene.objects)}
    if unknown := sorted(set(np.unique(scene.mesh.face_instance).tolist()) - known):
        raise UserError(
            f"scene {scene.name}: got faces of the instances {unknown[:10]}, expected instances of scene.objects; "
            "list every object of the mesh (0 is the building)"
        )


def _grid_for(scene: Scene, spec: GroundTruthSpec) -> Grid:
    """Return the grid of the maps, centred on the free space; it must contain all free space and all boxes."""
    if (needed := needed_extent(scene)) >= spec.extent:
        raise UserError(
            f"scene {scene.name} is larger than the map: got ground_truth.extent {spec.extent} m, expected at least "
            f"{needed + 3 * spec.resolution:.2f} m; raise the extent or leave the scene out"
        )
    (x, y), _ = _reach(scene)
    return Grid.centred(spec.extent, spec.resolution, (float(x), float(y)))


def _reach(scene: Scene) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "n 2"]]:
    """Return the centre of the free space, and all of its cells and the corners of boxes, as world x, y."""
    free = scene.free_space
    positions = free.grid.to_points(np.argwhere(free.mask))
    centre = (positions.min(axis=0) + positions.max(axis=0)) / 2
    return centre, np.concatenate([positions, *(obj.box.footprint() for obj in scene.objects)])


def _render_panoramas(
    scene: Scene,
    renderer: SceneRenderer,
    spec: GroundTruthSpec,
    names: Sequence[str],
    grid: Grid,
    points: Float[np.ndarray, "n 2"],
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "c h w"]]:
    """Return M_occu and, for each category, the cells with depth returns up to the ceiling (M_seg before dilation)."""
    occupied = np.zeros(grid.shape, bool)
    returns = np.zeros((len(names), *grid.shape), bool)
    lookup = scene.category_of_instance(names)
    full_height = Band(0.0, scene.ceiling_height - scene.floor_height)
    for pose in _panorama_poses(points, spec.camera):
        camera_to_world = spec.camera.to_world(pose, scene.floor_height)
        image = renderer.render(spec.camera, camera_to_world, colour=False)
        view = spec.camera, camera_to_world, scene.floor_height
        splat(image.depth, *view, spec.obstacles, grid, occupied)
        categories = lookup[np.maximum(image.instance, 0)]
        for index in np.unique(categories[categories > 0]):
            splat(image.depth, *view, full_height, grid, returns[index - 1], select=categories == index)
    return occupied, returns


def _panorama_poses(points: Float[np.ndarray, "n 2"], camera: Camera) -> Iterator[Pose]:
    """Yield the poses of a 360-degree panorama at each point."""
    count = int(np.ceil(2 * np.pi / camera.field_of_view - 1e-6))
    for x, y in points.tolist():
        for turn in range(count):
            yield Pose(x, y, 2 * np.pi * turn / count)


def _warn_of_missing(scene: Scene, grid: Grid, names: Sequence[str], gt: Bool[np.ndarray, "c h w"]) -> None:
    """Log a warning for the objects of each category without a cell in M_gt."""
    for name, layer in zip(names, gt, strict=True):
        objects = scene.of_category(name)
        missing = [str(obj.instance) for obj in objects if not _has_cell(layer, obj, grid)]
        if missing:
            log.warning(
                f"scene {scene.name}: {len(missing)} of {len(objects)} objects of category {name} have no cell in the "
                f"ground truth (instances {', '.join(missing)}): no panorama sees them within the obstacle "
                "heights; `python -m imagination.render` draws every stage"
            )


def _has_cell(layer: Bool[np.ndarray, "h w"], obj: SceneObject, grid: Grid) -> bool:
    """Return whether a map has a cell inside the box of an object."""
    window, inside = box_cells(obj.box, grid)
    return bool((layer[window] & inside).any())
