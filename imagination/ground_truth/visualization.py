"""Figures of every stage of the ground truth, for visual inspection.

Maps are drawn in world coordinates, with the objects' boxes and the panorama points as vector graphics on top: a
mirrored or shifted map does not match the outlines.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.ground_truth.scene_maps import GroundTruth
from imagination.scenes.categories import CategoryTable
from imagination.scenes.scene import Scene

EMPTY, FREE, OCCUPIED = (255, 255, 255), (222, 236, 222), (150, 150, 150)
"""RGB colours of cells without a category."""

MARGIN = 0.5
"""Margin of the map around the scene, metres."""
MIN_NAMED_SIZE = 0.35
"""Longest side up to which the names of objects are left out, metres."""


class LabelledView(NamedTuple):
    """One view with its maps and targets.

    Attributes:
        pose: pose of the robot.
        category: row of the category table whose targets are drawn.
        rgb, depth, instance: rendered image.
        occupied, seen: egocentric maps projected from depth.
        objects, imaginable, label, neighbourhood: V_object, V_filter, V_label and M*_seen of the category.
    """

    pose: Pose
    category: int
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    instance: Int32[np.ndarray, "h w"]
    occupied: Bool[np.ndarray, "v v"]
    seen: Bool[np.ndarray, "v v"]
    objects: Bool[np.ndarray, "v v"]
    imaginable: Bool[np.ndarray, "v v"]
    label: Bool[np.ndarray, "v v"]
    neighbourhood: Bool[np.ndarray, "v v"]


def draw_scene(
    scene: Scene, ground_truth: GroundTruth, categories: CategoryTable, views: Sequence[LabelledView]
) -> Figure:
    """Draw the free space with the panorama points, M_occu, and M_gt of all categories with the poses of the views."""
    figure = _figure(13.0, 4.9)
    free, occupied, gt_axes = figure.subplots(1, 3)
    _show_map(free, _paint(scene.free_space.mask, FREE), scene.free_space.grid, scene)
    free.plot(*ground_truth.points.T, ".", color="black", markersize=1.0)
    _name_objects(free, scene, 3.5)
    free.set_title(f"free space and {len(ground_truth.points)} panorama points", fontsize=9)
    _show_map(occupied, _paint(ground_truth.occupied, OCCUPIED), ground_truth.grid, scene)
    occupied.set_title("M_occu", fontsize=9)
    _draw_ground_truth(gt_axes, scene, ground_truth, categories)
    gt_axes.set_title("M_gt of " + ", ".join(categories.names), fontsize=9)
    for number, view in enumerate(views, start=1):
        x, y, theta = view.pose
        gt_axes.annotate(
            "", (x + 0.6 * np.cos(theta), y + 0.6 * np.sin(theta)), (x, y), arrowprops={"arrowstyle": "->"}
        )
        behind = x - 0.35 * np.cos(theta), y - 0.35 * np.sin(theta)
        gt_axes.text(*behind, str(number), fontsize=8, weight="bold", ha="center", va="center")
    return figure


def draw_category(scene: Scene, ground_truth: GroundTruth, categories: CategoryTable, name: str) -> Figure:
    """Draw M_label, M_seg and M_gt of one category."""
    layer, colour = categories.index(name) - 1, categories.rows[categories.index(name) - 1].colour
    figure = _figure(13.0, 4.9)
    stages = {
        "M_label": ground_truth.label,
        "M_seg": ground_truth.segmented,
        "M_gt = M_occu & M_label & M_seg": ground_truth.truth,
    }
    for axes, (title, stage) in zip(figure.subplots(1, 3), stages.items(), strict=True):
        image = _paint(ground_truth.occupied, OCCUPIED)
        image[stage[layer]] = colour
        _show_map(axes, image, ground_truth.grid, scene, name)
        axes.set_title(f"{title}: {name}", fontsize=9)
    return figure


def draw_views(views: Sequence[LabelledView], ego: EgoGrid) -> Figure:
    """Draw one row for each view: colour, depth, instances, and the egocentric projection of depth."""
    figure = _figure(11.0, 2.8 * len(views))
    palette = np.random.default_rng(3).integers(60, 256, (4096, 3), dtype=np.uint8)
    palette[0] = 235  # the building
    for number, (row, view) in enumerate(
        zip(figure.subplots(len(views), 4, squeeze=False), views, strict=True), 1
    ):
        row[0].imshow(view.rgb)
        row[0].set_title(f"view {number}: RGB", fontsize=9)
        depth = row[1].imshow(np.where(view.depth > 0, view.depth, np.nan), cmap="viridis_r", vmin=0)
        row[1].set_title("depth, m", fontsize=9)
        figure.colorbar(depth, ax=row[1], fraction=0.046)
        row[2].imshow(
            np.where((view.instance < 0)[..., None], np.uint8(0), palette[view.instance % len(palette)])
        )
        row[2].set_title("instances", fontsize=9)
        for axes in row[:3]:
            axes.set_xticks([])
            axes.set_yticks([])
        image = _paint(view.seen, FREE)
        image[view.occupied] = 0
        _show_ego(row[3], image, ego)
        row[3].set_title("occupied and V_seen", fontsize=9)
    return figure


def draw_labels(views: Sequence[LabelledView], ego: EgoGrid, categories: CategoryTable) -> Figure:
    """Draw one row for each view: V_object, V_object * V_seen, V_filter, V_label and M*_seen over the seen area."""
    figure = _figure(13.0, 2.9 * len(views))
    for number, (row, view) in enumerate(
        zip(figure.subplots(len(views), 5, squeeze=False), views, strict=True), 1
    ):
        category = categories.rows[view.category]
        stages = {
            f"view {number}: V_object, {category.name}": view.objects,
            "V_object * V_seen": view.objects & view.seen,
            "V_filter": view.imaginable,
            "V_label = V_object * V_filter": view.label,
            "M*_seen": view.neighbourhood,
        }
        for axes, (title, stage) in zip(row, stages.items(), strict=True):
            image = _paint(view.seen, FREE)
            image[view.occupied] = OCCUPIED
            image[stage] = category.colour
            _show_ego(axes, image, ego)
            axes.set_title(title, fontsize=9)
    return figure


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _paint(mask: Bool[np.ndarray, "h w"], colour: tuple[int, int, int]) -> UInt8[np.ndarray, "h w 3"]:
    return np.where(mask[..., None], np.array(colour, np.uint8), np.array(EMPTY, np.uint8))


def _show_map(
    axes: Axes, image: UInt8[np.ndarray, "h w 3"], grid: Grid, scene: Scene, category: str | None = None
) -> None:
    """Draw a global map in world coordinates, with outlines of the boxes of one category (of all if None)."""
    x, y = grid.origin
    extent = (x, x + grid.columns * grid.resolution, y, y + grid.rows * grid.resolution)
    axes.imshow(image, extent=extent, interpolation="nearest")
    for obj in scene.objects:
        if obj.category is not None and category in (None, obj.category):
            axes.add_patch(Polygon(obj.box.footprint(), fill=False, linewidth=0.6))
    low, high = _bounds(scene)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x, m", ylabel="y, m")


def show_ground_truth(axes: Axes, scene: Scene, ground_truth: GroundTruth, categories: CategoryTable) -> None:
    """Draw M_gt of all categories over M_occu, with the names of the objects."""
    _draw_ground_truth(axes, scene, ground_truth, categories)
    _name_objects(axes, scene, 5.0)


def _draw_ground_truth(
    axes: Axes, scene: Scene, ground_truth: GroundTruth, categories: CategoryTable
) -> None:
    image = _paint(ground_truth.occupied, OCCUPIED)
    for row, layer in zip(categories, ground_truth.truth, strict=True):
        image[layer] = row.colour
    _show_map(axes, image, ground_truth.grid, scene)


def _bounds(scene: Scene) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the smallest and largest x, y of a map; the mesh may be empty if the scene has its own renderer."""
    positions = scene.free_space.grid.to_points(np.argwhere(scene.free_space.mask))
    boxes = [obj.box.footprint() for obj in scene.objects]
    points = np.concatenate([positions, *boxes, scene.mesh.vertices[:, :2]])
    return points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN


def _name_objects(axes: Axes, scene: Scene, font_size: float) -> None:
    """Write the label of every object larger than MIN_NAMED_SIZE at its centre."""
    for obj in scene.objects:
        if max(obj.box.size[:2]) > MIN_NAMED_SIZE:
            x, y, _ = obj.box.centre
            axes.text(
                x, y, obj.label.replace("_", "\n"), fontsize=font_size, ha="center", va="center", clip_on=True
            )


def _show_ego(axes: Axes, image: UInt8[np.ndarray, "v v 3"], ego: EgoGrid) -> None:
    """Draw an egocentric map in metres, with the robot at the bottom centre."""
    half, cell = ego.cells * ego.resolution / 2, ego.resolution
    axes.imshow(image, extent=(-half, half, -cell / 2, ego.cells * cell - cell / 2), interpolation="nearest")
    axes.plot(0, 0, marker="^", color="black", markersize=5, clip_on=False)
