"""Semantic maps: occupancy, one probability layer per category, and the objects extracted from them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int64

from imagination.geometry.grid import Grid
from imagination.utils.errors import UserError, check_choice, check_range

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Values of ROS' nav_msgs/OccupancyGrid; values from 0 to 100 are percent."""

FREE_BELOW, OCCUPIED_FROM = 0.25, 0.5
"""Bounds of the occupancy probability between which a cell is unknown because views disagree."""

Layer = Int8[np.ndarray, "h w"]
"""Values as in nav_msgs/OccupancyGrid, but with row 0 at the largest y (docs/concepts/conventions.md)."""

Corner = tuple[int, int]
"""Corner of a cell (row, column); (0, 0) is the upper-left corner of the map."""


class MapObject(NamedTuple):
    """Object extracted from a map.

    Attributes:
        category: name of the category.
        outline: world x, y of the corners, counter-clockwise, metres; the first corner is not repeated.
        holes: outlines of the enclosed holes, clockwise.
        confidence: mean probability of the cells.
        area: area of the cells, m2.
    """

    category: str
    outline: Float64[np.ndarray, "n 2"]
    holes: list[Float64[np.ndarray, "_ 2"]]
    confidence: float
    area: float

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the bounding box, world x, y, metres."""
        x, y = ((self.outline.min(axis=0) + self.outline.max(axis=0)) / 2).tolist()
        return x, y


@dataclass(frozen=True, eq=False)
class Maps:
    """Semantic map.

    Attributes:
        grid: grid of all layers.
        frame: id of the frame of the grid's origin.
        categories: names of the category layers.
        thresholds: probability of each category from which a cell belongs to an object.
        probabilities: probability of each category; 0 in cells without evidence.
        written: mask of each category's cells with evidence.
        occupancy: probability that a cell is occupied; 0 in cells without evidence.
        known: mask of the cells whose occupancy was observed.
    """

    grid: Grid
    frame: str
    categories: tuple[str, ...]
    thresholds: tuple[float, ...]
    probabilities: Float32[np.ndarray, "c h w"]
    written: Bool[np.ndarray, "c h w"]
    occupancy: Float32[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]

    def __post_init__(self) -> None:
        shape = len(self.categories), *self.grid.shape
        for name in ("probabilities", "written", "occupancy", "known"):
            got, expected = getattr(self, name).shape, shape[-2:] if name in ("occupancy", "known") else shape
            if got != expected:
                raise UserError(f"{name}: got shape {got}, expected {expected}")
        if len(self.thresholds) != len(self.categories):
            raise UserError(f"thresholds: got {len(self.thresholds)}, expected {len(self.categories)}")
        for threshold in self.thresholds:
            check_range("threshold", threshold, 0.0, 1.0, open_low=True)

    def occupancy_layer(self) -> Layer:
        """Return occupied, free and unknown cells for navigation."""
        layer = np.full(self.grid.shape, UNKNOWN, np.int8)
        layer[self.known & (self.occupancy < FREE_BELOW)] = FREE
        layer[self.known & (self.occupancy >= OCCUPIED_FROM)] = OCCUPIED
        return layer

    def category_layer(self, category: str) -> Layer:
        """Return the probability of a category in percent, -1 in cells without evidence.

        Raises:
            UserError: if the map has no such category.
        """
        index = self.categories.index(check_choice("category", category, self.categories))
        percent = np.rint(100 * self.probabilities[index]).astype(np.int8)
        return np.where(self.written[index], percent, np.int8(UNKNOWN))

    def objects(self, smallest: float = 0.02) -> list[MapObject]:
        """Extract objects: connected cells of one category, with outlines along the edges of the cells.

        Args:
            smallest: smallest area of an object, m2.

        Raises:
            UserError: if `smallest` is out of range.
        """
        check_range("smallest", smallest, 0.0, 100.0, "m2")
        objects = []
        layers = zip(self.categories, self.probabilities, self.thresholds, strict=True)
        for category, layer, threshold in layers:
            cells = (layer >= threshold).astype(np.uint8)
            count, labels, stats, _ = cv2.connectedComponentsWithStats(cells, connectivity=4)
            for label in range(1, count):
                left, top, width, height, size = stats[label].tolist()
                area = size * self.grid.resolution**2
                if area < smallest:
                    continue
                window = np.s_[top : top + height, left : left + width]
                mask = labels[window] == label
                outline, *holes = (self._to_world(loop + [top, left]) for loop in _edges(mask))
                objects.append(MapObject(category, outline, holes, float(layer[window][mask].mean()), area))
        return objects

    def _to_world(self, corners: np.ndarray) -> Float64[np.ndarray, "n 2"]:
        """Return the world x, y of cell corners; see `Corner`."""
        x, y = self.grid.origin
        size = self.grid.resolution
        return np.column_stack([x + corners[:, 1] * size, y + (self.grid.rows - corners[:, 0]) * size])


def _edges(mask: Bool[np.ndarray, "h w"]) -> list[Int64[np.ndarray, "_ 2"]]:
    """Trace the outline of a 4-connected region, then those of its holes, as corners (row, column).

    The region is on the left of each edge; where two cells touch only at a corner, the walk stays with the same cell.
    """
    padded = np.pad(mask, 1)
    ends: dict[Corner, list[Corner]] = {}
    # each side: offset of the neighbour that must be empty, start and end of the edge
    for (dr, dc), begin, end in (
        ((-1, 0), (0, 1), (0, 0)),
        ((0, -1), (0, 0), (1, 0)),
        ((1, 0), (1, 0), (1, 1)),
        ((0, 1), (1, 1), (0, 1)),
    ):
        empty = ~padded[1 + dr : padded.shape[0] - 1 + dr, 1 + dc : padded.shape[1] - 1 + dc]
        for r, c in np.argwhere(mask & empty).tolist():
            ends.setdefault((r + begin[0], c + begin[1]), []).append((r + end[0], c + end[1]))
    remaining = {(start, end) for start, candidates in ends.items() for end in candidates}
    loops = []
    while remaining:
        # the outline comes first: the uppermost edge cannot belong to a hole
        edge = first = min(remaining)
        loop = []
        while edge in remaining:
            remaining.remove(edge)
            following = _next(edge, ends)
            if following[1][0] - following[0][0] != edge[1][0] - edge[0][0]:  # a turn
                loop.append(edge[1])
            edge = following
        assert edge == first, "the edges of a region form loops"
        loops.append(np.array(loop))
    return loops


def _next(edge: tuple[Corner, Corner], ends: Mapping[Corner, Sequence[Corner]]) -> tuple[Corner, Corner]:
    (r0, c0), (r1, c1) = edge
    turn_left = r1 - (c1 - c0), c1 + (r1 - r0)
    candidates = ends[edge[1]]
    return edge[1], turn_left if turn_left in candidates else candidates[0]
