"""Global maps of one trial: the evidence of its views, registered in order."""

from collections.abc import Mapping
from math import hypot
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from imagination.evaluation.approaches import Approach, Predictions, Setting
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.ground_truth.scene_maps import GroundTruth
from imagination.mapping.mapper import Mapper
from imagination.mapping.update_rules import Max
from imagination.views.collector import Views


class Area(NamedTuple):
    """Part of a scene's ground truth that the views of a trial can reach.

    Attributes:
        grid: grid of the part.
        truth: ground-truth map M_gt of the evaluated categories.
        occupied: occupancy map M_occu.
    """

    grid: Grid
    truth: Bool[np.ndarray, "c h w"]
    occupied: Bool[np.ndarray, "h w"]


def area_of(
    gt: GroundTruth, layers: list[int], poses: Float64[np.ndarray, "n 3"], ego: EgoGrid, margin: float
) -> Area:
    """Crop a scene's maps to its ground truth and everything its views reach, which changes no count of pixels.

    Args:
        gt: ground truth of the scene.
        layers: rows of the category table that are evaluated.
        poses: poses of the views.
        ego: egocentric grid of the views.
        margin: dilation of cells in postprocessing, metres.
    """
    grid = gt.grid
    reach = hypot(ego.cells, ego.cells / 2) * ego.resolution + margin
    corners = np.concatenate([poses[:, :2] - reach, poses[:, :2] + reach])
    filled = np.argwhere(gt.occupied | gt.truth[layers].any(axis=0))
    cells = np.concatenate([grid.to_cells(corners), filled])
    if not len(cells):
        return Area(grid, gt.truth[layers], gt.occupied)
    top, left = np.clip(cells.min(axis=0), 0, np.array(grid.shape) - 1).tolist()
    bottom, right = np.clip(cells.max(axis=0) + 1, 1, grid.shape).tolist()
    size = grid.resolution
    origin = (grid.origin[0] + left * size, grid.origin[1] + (grid.rows - bottom) * size)
    window = np.s_[..., top:bottom, left:right]
    part = Grid(size, bottom - top, right - left, origin)
    return Area(part, gt.truth[layers][window], gt.occupied[window])


def score_maps(
    views: Views,
    predictions: Predictions,
    approaches: Mapping[str, Approach],
    setting: Setting,
    grid: Grid,
    order: Int64[np.ndarray, " n"],
) -> dict[str, Float32[np.ndarray, "c h w"]]:
    """Compute the global score map of each approach, before its threshold; cells without evidence are 0.

    Args:
        views: views of one trial.
        predictions: network predictions for each view.
        approaches: approaches by name; those with the same evidence source and rule share one map.
        setting: camera, grid and categories.
        grid: grid of the maps.
        order: order in which the views are registered.
    """
    by_key: dict[tuple[Any, ...], Float32[np.ndarray, "c h w"]] = {}
    for approach in approaches.values():
        if approach.map_key in by_key:
            continue
        evidence = approach.evidence(views, predictions, setting)
        mapper = Mapper(grid, setting.ego, setting.categories, approach.rule)
        for index in order.tolist():
            pose = Pose(*views["pose"][index].tolist())
            imagined = None if evidence.imagined is None else evidence.imagined[index]
            mapper.register(evidence.values[index], evidence.mask[index], pose, imagined)
        by_key[approach.map_key] = mapper.probabilities
    return {name: by_key[approach.map_key] for name, approach in approaches.items()}


def seen_map(views: Views, ego: EgoGrid, grid: Grid) -> Bool[np.ndarray, "h w"]:
    """Return the global cells that at least one view saw: V_seen of all views, registered."""
    mapper = Mapper(grid, ego, ["seen"], Max())
    everywhere = np.ones((1, ego.cells, ego.cells), np.float32)
    for seen, pose in zip(views["seen"], views["pose"], strict=True):
        mapper.register(everywhere, seen[None], Pose(*pose.tolist()))
    seen_cells: Bool[np.ndarray, "h w"] = mapper.probabilities[0] > 0
    return seen_cells
