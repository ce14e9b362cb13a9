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
    """How ground-truth maps are made.

    Attributes:
        extent, resolution: side of the map and of its cells, metres.
        spacing: between the points that look around, metres.
        dilation: side of the square that M_seg is dilated with, metres.
        obstacles: heights above the floor whose returns count as occupied.
        camera: looks from the points; its field of view decides how many looks make 360 degrees.
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
    """The maps of one scene; layers in the category table's order.

    Attributes:
        grid: of all maps, centred on the free space.
        occupied: M_occu, cells in which a return lies between the obstacles' heights; walls and furniture alike.
        label: M_label, cells whose centre lies in the box of an object of the category.
        segmented: M_seg, cells in which a return of the category lies at any height, dilated.
        truth: M_gt, the intersection.
        points: world x, y of the points that looked around, metres.
    """

    grid: Grid
    occupied: Bool[np.ndarray, "h w"]
    label: Bool[np.ndarray, "c h w"]
    segmented: Bool[np.ndarray, "c h w"]
    truth: Bool[np.ndarray, "c h w"]
    points: Float[np.ndarray, "n 2"]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Everything as arrays, for files."""
        frame = np.array([self.grid.resolution, *self.grid.origin])
        return {"resolution_and_origin": frame, **{name: getattr(self, name) for name in self._fields[1:]}}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "GroundTruth":
        """What `to_arrays` gave."""
        resolution, x, y = arrays["resolution_and_origin"].tolist()
        rows, columns = arrays["occupied"].shape
        return cls(Grid(resolution, rows, columns, (x, y)), *(arrays[name] for name in cls._fields[1:]))


def build(
    scene: Scene, renderer: SceneRenderer, spec: GroundTruthSpec, categories: CategoryTable
) -> GroundTruth:
    """Make the maps of a scene, for all categories of the table.

    Warns about every object of a category that has no cell in M_gt: nothing of it was seen at the obstacles' heights.

    Args:
        scene: with its free space, where the looks are taken.
        renderer: of the scene's mesh.
        spec: how.
        categories: one layer each.

    Raises:
        UserError: if the scene is larger than the map, or its mesh and its list of objects do not belong together.
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
    truth = occupied & label & segmented
    _warn_of_lost(scene, grid, categories.names, truth)
    return GroundTruth(grid, occupied, label, segmented, truth, points)


def panorama_points(free: FreeSpace, spacing: float) -> Float[np.ndarray, "n 2"]:
    """World x, y of the points that look around: one in each square of side `spacing` that holds free space.

    It is the free cell nearest to the square's centre, so that narrow passages are looked into as well.
    """
    cells = np.argwhere(free.mask)
    places = free.grid.to_points(cells)
    offset = (places - places.min(axis=0)) / spacing
    square = np.floor(offset + 1e-6).astype(np.int64)
    distance = np.abs(offset - square - 0.5).max(axis=1)
    order = np.lexsort((distance, square[:, 1], square[:, 0]))
    _, first = np.unique(square[order], axis=0, return_index=True)
    return places[order[first]]


def needed_extent(scene: Scene) -> float:
    """Side of the smallest map, centred on the free space, that holds all free space and all boxes, metres."""
    centre, corners = _reach(scene)
    return float(2 * np.abs(corners - centre).max())


def box_cells(box: OrientedBox, grid: Grid) -> tuple[tuple[slice, slice], Bool[np.ndarray, "a b"]]:
    """The cells whose centre lies in a box seen from above: a window of the grid and which of its cells."""
    corners = np.clip(grid.to_cells(box.footprint()), 0, np.array(grid.shape) - 1)
    (top, left), (bottom, right) = corners.min(axis=0), corners.max(axis=0)
    window = slice(top, bottom + 1), slice(left, right + 1)
    rows, columns = np.ogrid[window]
    cells = np.stack(np.broadcast_arrays(rows, columns), axis=-1)
    inside_box = Pose(*box.centre[:2], box.yaw).to_robot(grid.to_points(cells))
    tolerance = 1e-6  # of centres that lie on an edge
    return window, (np.abs(inside_box) <= np.array(box.size[:2]) / 2 + tolerance).all(axis=-1)


def _check_instances(scene: Scene) -> None:
    known = {0, *(obj.instance for obj in scene.objects)}
    if unknown := sorted(set(np.unique(scene.mesh.face_instance).tolist()) - known):
        raise UserError(
            f"scene {scene.name}: its mesh has faces of the instances {unknown[:10]}, which scene.objects does not "
            "list; list every object of the mesh (0 is the building)"
        )


def _grid_for(scene: Scene, spec: GroundTruthSpec) -> Grid:
    """The map, centred on the free space; all free space and all boxes must lie in it."""
    if (needed := needed_extent(scene)) >= spec.extent:
        raise UserError(
            f"scene {scene.name} is larger than the map: got ground_truth.extent {spec.extent} m, expected at least "
            f"{needed + 3 * spec.resolution:.2f} m; raise the extent or leave the scene out"
        )
    (x, y), _ = _reach(scene)
    return Grid.centred(spec.extent, spec.resolution, (float(x), float(y)))


def _reach(scene: Scene) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "n 2"]]:
    """The middle of the free space, and all places of it and corners of boxes: world x, y."""
    free = scene.free_space
    places = free.grid.to_points(np.argwhere(free.mask))
    centre = (places.min(axis=0) + places.max(axis=0)) / 2
    return centre, np.concatenate([places, *(obj.box.footprint() for obj in scene.objects)])


def _render_panoramas(
    scene: Scene,
    renderer: SceneRenderer,
    spec: GroundTruthSpec,
    names: Sequence[str],
    grid: Grid,
    points: Float[np.ndarray, "n 2"],
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "c h w"]]:
    """M_occu, and the cells with returns of each category between floor and ceiling (M_seg before its dilation)."""
    occupied = np.zeros(grid.shape, bool)
    returns = np.zeros((len(names), *grid.shape), bool)
    lookup = scene.category_of_instance(names)
    room = Band(0.0, scene.ceiling_height - scene.floor_height)
    for pose in _panorama_poses(points, spec.camera):
        camera_to_world = spec.camera.to_world(pose, scene.floor_height)
        image = renderer.render(spec.camera, camera_to_world, colour=False)
        frame = spec.camera, camera_to_world, scene.floor_height
        splat(image.depth, *frame, spec.obstacles, grid, occupied)
        categories = lookup[np.maximum(image.instance, 0)]
        for index in np.unique(categories[categories > 0]):
            splat(image.depth, *frame, room, grid, returns[index - 1], select=categories == index)
    return occupied, returns


def _panorama_poses(points: Float[np.ndarray, "n 2"], camera: Camera) -> Iterator[Pose]:
    """360 degrees around each point."""
    count = int(np.ceil(2 * np.pi / camera.field_of_view - 1e-6))
    for x, y in points.tolist():
        for turn in range(count):
            yield Pose(x, y, 2 * np.pi * turn / count)


def _warn_of_lost(scene: Scene, grid: Grid, names: Sequence[str], truth: Bool[np.ndarray, "c h w"]) -> None:
    for name, layer in zip(names, truth, strict=True):
        objects = scene.of_category(name)
        lost = [str(obj.instance) for obj in objects if not _any_in(layer, obj, grid)]
        if lost:
            log.warning(
                f"scene {scene.name}: {len(lost)} of {len(objects)} objects of category {name} have no cell in the "
                f"ground truth (instances {', '.join(lost)}): nothing of them was seen between the obstacles' "
                "heights; `python -m imagination.render` draws every stage"
            )


def _any_in(layer: Bool[np.ndarray, "h w"], obj: SceneObject, grid: Grid) -> bool:
    window, inside = box_cells(obj.box, grid)
    return bool((layer[window] & inside).any())
