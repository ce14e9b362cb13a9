"""Global maps of one run: the statements of its views, registered in order."""

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
    """The part of a scene's ground truth that a run can write to.

    Attributes:
        grid: of the part.
        truth: M_gt of the evaluated categories.
        occupied: M_occu.
    """

    grid: Grid
    truth: Bool[np.ndarray, "c h w"]
    occupied: Bool[np.ndarray, "h w"]


def area_of(
    truth: GroundTruth, layers: list[int], poses: Float64[np.ndarray, "n 3"], ego: EgoGrid, margin: float
) -> Area:
    """Crop a scene's maps to all of its truth and everything its views reach, which changes no count of pixels.

    Args:
        truth: the scene's maps.
        layers: rows of the category table that are evaluated.
        poses: of the views.
        ego: grid of the views.
        margin: how far cells are grown afterwards, metres.
    """
    grid = truth.grid
    reach = hypot(ego.cells, ego.cells / 2) * ego.resolution + margin
    corners = np.concatenate([poses[:, :2] - reach, poses[:, :2] + reach])
    filled = np.argwhere(truth.occupied | truth.truth[layers].any(axis=0))
    cells = np.concatenate([grid.to_cells(corners), filled])
    if not len(cells):
        return Area(grid, truth.truth[layers], truth.occupied)
    top, left = np.clip(cells.min(axis=0), 0, np.array(grid.shape) - 1).tolist()
    bottom, right = np.clip(cells.max(axis=0) + 1, 1, grid.shape).tolist()
    size = grid.resolution
    origin = (grid.origin[0] + left * size, grid.origin[1] + (grid.rows - bottom) * size)
    window = np.s_[..., top:bottom, left:right]
    part = Grid(size, bottom - top, right - left, origin)
    return Area(part, truth.truth[layers][window], truth.occupied[window])


def score_maps(
    views: Views,
    predictions: Predictions,
    approaches: Mapping[str, Approach],
    setting: Setting,
    grid: Grid,
    order: Int64[np.ndarray, " n"],
) -> dict[str, Float32[np.ndarray, "c h w"]]:
    """The global map of each approach, before its threshold; 0 where nothing was said.

    Args:
        views: of one run.
        predictions: the networks' answers to each.
        approaches: those with the same evidence and rule share one map.
        setting: camera, grid and categories.
        grid: of the maps.
        order: in which the views are registered.
    """
    by_key: dict[tuple[Any, ...], Float32[np.ndarray, "c h w"]] = {}
    for approach in approaches.values():
        if approach.map_key in by_key:
            continue
        statement = approach.evidence(views, predictions, setting)
        mapper = Mapper(grid, setting.ego, setting.categories, approach.rule)
        for index in order.tolist():
            pose = Pose(*views["pose"][index].tolist())
            imagined = None if statement.imagined is None else statement.imagined[index]
            mapper.register(statement.values[index], statement.mask[index], pose, imagined)
        by_key[approach.map_key] = mapper.probabilities
    return {name: by_key[approach.map_key] for name, approach in approaches.items()}


def seen_map(views: Views, ego: EgoGrid, grid: Grid) -> Bool[np.ndarray, "h w"]:
    """The global cells that a view saw: V_seen of all views, registered."""
    mapper = Mapper(grid, ego, ["seen"], Max())
    everywhere = np.ones((1, ego.cells, ego.cells), np.float32)
    for seen, pose in zip(views["seen"], views["pose"], strict=True):
        mapper.register(everywhere, seen[None], Pose(*pose.tolist()))
    seen_cells: Bool[np.ndarray, "h w"] = mapper.probabilities[0] > 0
    return seen_cells
