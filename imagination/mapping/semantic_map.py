"""What a mapper has to give: occupancy, a probability for each category, and the objects found in them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int64

from imagination.geometry.grid import Grid
from imagination.utils.errors import UserError, check_choice, check_range

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Values of ROS' nav_msgs/OccupancyGrid; those between are percent."""

FREE_BELOW, OCCUPIED_FROM = 0.25, 0.5
"""Occupancy between these is unknown: views disagree."""

Layer = Int8[np.ndarray, "h w"]
"""A map as nav_msgs/OccupancyGrid holds it, but with row 0 at the largest y (docs/conventions.md)."""


Corner = tuple[int, int]
"""Of a cell: row and column, (0, 0) the upper-left one of the map."""


class MapObject(NamedTuple):
    """An object found in a map.

    Attributes:
        category: its name.
        outline: world x, y of its corners, counter-clockwise, metres; the first is not repeated.
        holes: outlines of what it encloses, clockwise.
        confidence: mean probability of its cells.
        area: m2.
    """

    category: str
    outline: Float64[np.ndarray, "n 2"]
    holes: list[Float64[np.ndarray, "_ 2"]]
    confidence: float
    area: float

    @property
    def centre(self) -> tuple[float, float]:
        """Of its bounding box; world x, y, metres."""
        x, y = ((self.outline.min(axis=0) + self.outline.max(axis=0)) / 2).tolist()
        return x, y


@dataclass(frozen=True, eq=False)
class Maps:
    """A semantic map.

    Attributes:
        grid: of all layers.
        frame: id of the frame that the grid's origin is given in.
        categories: of the layers.
        thresholds: of the categories, probabilities from which a cell belongs to an object.
        probabilities: of each category; 0 where nothing was said.
        written: cells that a view has said something about.
        occupancy: probability that a cell is occupied; 0 where nothing was said.
        known: cells whose occupancy a view has seen.
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
            got, wanted = getattr(self, name).shape, shape[-2:] if name in ("occupancy", "known") else shape
            if got != wanted:
                raise UserError(f"{name}: got shape {got}, expected {wanted}")
        if len(self.thresholds) != len(self.categories):
            raise UserError(f"thresholds: got {len(self.thresholds)}, expected {len(self.categories)}")
        for threshold in self.thresholds:
            check_range("threshold", threshold, 0.0, 1.0, open_low=True)

    def occupancy_layer(self) -> Layer:
        """Occupied, free or unknown, as navigation takes it."""
        layer = np.full(self.grid.shape, UNKNOWN, np.int8)
        layer[self.known & (self.occupancy < FREE_BELOW)] = FREE
        layer[self.known & (self.occupancy >= OCCUPIED_FROM)] = OCCUPIED
        return layer

    def category_layer(self, category: str) -> Layer:
        """Probability of a category in percent, -1 where nothing was said.

        Raises:
            UserError: if there is no such category.
        """
        index = self.categories.index(check_choice("category", category, self.categories))
        percent = np.rint(100 * self.probabilities[index]).astype(np.int8)
        return np.where(self.written[index], percent, np.int8(UNKNOWN))

    def objects(self, smallest: float = 0.02) -> list[MapObject]:
        """Connected cells of one category, as outlines along the cells' edges.

        Args:
            smallest: objects of less than this many m2 are left out.

        Raises:
            UserError: if it is out of range.
        """
        check_range("smallest", smallest, 0.0, 100.0, "m2")
        found = []
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
                found.append(MapObject(category, outline, holes, float(layer[window][mask].mean()), area))
        return found

    def _to_world(self, corners: np.ndarray) -> Float64[np.ndarray, "n 2"]:
        """Corners of cells, (row, column) with (0, 0) the upper-left one of the map, in the world."""
        x, y = self.grid.origin
        size = self.grid.resolution
        return np.column_stack([x + corners[:, 1] * size, y + (self.grid.rows - corners[:, 0]) * size])


def _edges(mask: Bool[np.ndarray, "h w"]) -> list[Int64[np.ndarray, "_ 2"]]:
    """Outline of a 4-connected region, then of its holes, along the edges of its cells; corners as (row, column).

    Each edge is walked with the region on its left; where two cells meet only at a corner, the walk stays at its own.
    """
    padded = np.pad(mask, 1)
    ends: dict[Corner, list[Corner]] = {}
    # of each side: the neighbour that must be empty, and where the edge begins and ends
    for (dr, dc), begin, end in (
        ((-1, 0), (0, 1), (0, 0)),
        ((0, -1), (0, 0), (1, 0)),
        ((1, 0), (1, 0), (1, 1)),
        ((0, 1), (1, 1), (0, 1)),
    ):
        empty = ~padded[1 + dr : padded.shape[0] - 1 + dr, 1 + dc : padded.shape[1] - 1 + dc]
        for r, c in np.argwhere(mask & empty).tolist():
            ends.setdefault((r + begin[0], c + begin[1]), []).append((r + end[0], c + end[1]))
    left = {(start, end) for start, several in ends.items() for end in several}
    loops = []
    while left:
        # the region's outline first: its uppermost edge is that of no hole
        edge = first = min(left)
        loop = []
        while edge in left:
            left.remove(edge)
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
    several = ends[edge[1]]
    return edge[1], turn_left if turn_left in several else several[0]
