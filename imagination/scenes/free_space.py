"""Free space of a mesh: the connected part of the floor where a robot does not collide."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from imagination.geometry.grid import MAX_CELLS, Grid
from imagination.scenes.scene import FreeSpace, Mesh
from imagination.utils.errors import UserError, check_range
from imagination.utils.jit import compiled

MAX_SLOPE = 0.2
"""Maximum slope of the floor: horizontal by vertical component of the normal (11 degrees)."""

TOLERANCE = 1e-3
"""Distance within which a point counts as on a cell centre or border, cells; vertices are float32."""


def free_space(
    mesh: Mesh,
    floor_height: float,
    robot_radius: float,
    resolution: float = 0.05,
    clearance: tuple[float, float] = (0.05, 1.5),
) -> FreeSpace:
    """Compute the free space of the centre of a circular robot.

    A cell is free if its centre is on a floor triangle and no part of the mesh between the two heights of `clearance`
    is closer to it than the radius of the robot. Only the largest 4-connected component of the free cells is returned,
    which excludes the inside of furniture and rooms without an open door.

    Args:
        mesh: mesh of the whole scene.
        floor_height: world z of the floor, metres.
        robot_radius: radius of the robot, metres.
        resolution: side of the cells of the returned grid, metres.
        clearance: lowest and highest height of obstacles above the floor, metres.

    Raises:
        UserError: if the mesh has no floor at that height, or no cell is free.
    """
    check_range("robot_radius", robot_radius, 0.0, 5.0, "m")
    check_range("free_space.resolution", resolution, 0.005, 1.0, "m")
    low, high = clearance
    check_range(
        "clearance", high, max(low, 0.0), 10.0, "m (the upper height, above the lower one)", open_low=True
    )
    corners = mesh.vertices[mesh.faces]
    floor = corners[_is_floor(corners, floor_height, low)]
    if len(floor) == 0:
        raise UserError(
            f"free space: got no horizontal triangle within {low} m of the floor at {floor_height} m, expected "
            "at least one; check the floor height of the scene and that z points up"
        )
    grid = _grid_around(floor, resolution)
    on_floor = np.zeros(grid.shape, bool)
    _mark(floor, np.array(grid.origin), resolution, -np.inf, np.inf, True, on_floor)
    blocked = cells_below(corners, grid, floor_height + low, floor_height + high)
    free = _largest_component(on_floor & _cells_away_from(blocked, robot_radius / resolution))
    if not free.any():
        raise UserError(
            f"free space: got no free cell for a robot of radius {robot_radius} m on "
            f"{on_floor.sum() * resolution**2:.1f} m2 of floor; use a smaller radius or another scene"
        )
    return FreeSpace(grid, free)


def cells_below(
    corners: Float32[np.ndarray, "m 3 3"], grid: Grid, low: float, high: float
) -> Bool[np.ndarray, "h w"]:
    """Return the cells of a grid below any part of the triangles between two heights, metres."""
    cells = np.zeros(grid.shape, bool)
    _mark(corners, np.array(grid.origin), grid.resolution, low, high, False, cells)
    return cells


def _is_floor(
    corners: Float32[np.ndarray, "m 3 3"], floor_height: float, tolerance: float
) -> Bool[np.ndarray, " m"]:
    """Return which triangles are level and within `tolerance` of the floor height."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    level = np.hypot(normal[:, 0], normal[:, 1]) <= MAX_SLOPE * np.abs(normal[:, 2])
    near = (np.abs(corners[..., 2] - floor_height) <= tolerance).all(axis=1)
    floor: np.ndarray = level & near & (normal[:, 2] != 0)
    return floor


def _grid_around(floor: Float32[np.ndarray, "m 3 3"], resolution: float) -> Grid:
    """Return the grid that covers the floor triangles."""
    low, high = floor[..., :2].min(axis=(0, 1)).astype(float), floor[..., :2].max(axis=(0, 1)).astype(float)
    columns, rows = np.maximum(np.ceil((high - low) / resolution - 1e-4), 1).tolist()
    if not max(columns, rows) <= MAX_CELLS:
        raise UserError(
            f"free space: got a floor from {low} to {high} m, expected at most {MAX_CELLS} cells of {resolution} m "
            "a side; check that the scene is in metres"
        )
    return Grid(resolution, int(rows), int(columns), (float(low[0]), float(low[1])))


def _cells_away_from(blocked: Bool[np.ndarray, "h w"], radius: float) -> Bool[np.ndarray, "h w"]:
    """Return the cells whose centre is at least `radius` cells away from any point of a blocked cell."""
    distance = cv2.distanceTransform((~blocked).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    half_diagonal = np.sqrt(0.5)  # an obstacle may be at the nearest corner of its cell
    clear: np.ndarray = ~blocked & (distance >= radius + half_diagonal)
    return clear


def _largest_component(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the largest 4-connected component of a mask."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if len(stats) == 1:
        return mask
    return np.equal(labels, 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA]))


@compiled
def _mark(
    corners: Float32[np.ndarray, "m 3 3"],
    origin: Float64[np.ndarray, "2"],
    resolution: float,
    low: float,
    high: float,
    by_centre: bool,
    out: Bool[np.ndarray, "h w"],
) -> None:
    """Mark the cells below the part of each triangle between the heights `low` and `high`.

    A cell is marked if the part, seen from above, contains its centre (`by_centre`) or touches the cell.
    """
    rows, columns = out.shape
    polygon, spare = np.empty((8, 3)), np.empty((8, 3))
    reach = TOLERANCE if by_centre else 0.5 + TOLERANCE  # half side of the square that the part must touch
    for index in range(corners.shape[0]):
        for k in range(3):
            for axis in range(3):
                polygon[k, axis] = corners[index, k, axis]
        count = _clip(polygon, 3, spare, low, 1.0)
        count = _clip(spare, count, polygon, -high, -1.0)
        if count == 0:
            continue
        for k in range(count):  # to cells: x increases with the column, y decreases with the row
            polygon[k, 0] = (polygon[k, 0] - origin[0]) / resolution
            polygon[k, 1] = (polygon[k, 1] - origin[1]) / resolution
        first_x = max(int(np.floor(polygon[:count, 0].min() - 0.5)), 0)
        last_x = min(int(np.floor(polygon[:count, 0].max() + 0.5)), columns - 1)
        first_y = max(int(np.floor(polygon[:count, 1].min() - 0.5)), 0)
        last_y = min(int(np.floor(polygon[:count, 1].max() + 0.5)), rows - 1)
        for y in range(first_y, last_y + 1):
            for x in range(first_x, last_x + 1):
                if not out[rows - 1 - y, x] and _touches(polygon, count, x + 0.5, y + 0.5, reach):
                    out[rows - 1 - y, x] = True


@compiled
def _clip(
    polygon: Float64[np.ndarray, "8 3"],
    count: int,
    out: Float64[np.ndarray, "8 3"],
    bound: float,
    sign: float,
) -> int:
    """Clip a convex polygon to sign * z >= bound (Sutherland-Hodgman) and return its number of corners."""
    corners = 0
    for k in range(count):
        start, end = polygon[k], polygon[(k + 1) % count]
        start_height, end_height = sign * start[2] - bound, sign * end[2] - bound
        if start_height >= 0:
            out[corners] = start
            corners += 1
        if (start_height > 0 and end_height < 0) or (start_height < 0 and end_height > 0):
            fraction = start_height / (start_height - end_height)
            out[corners] = start + fraction * (end - start)
            corners += 1
    return corners


@compiled
def _touches(polygon: Float64[np.ndarray, "8 3"], count: int, x: float, y: float, reach: float) -> bool:
    """Return whether a convex polygon, seen from above, touches the square of half side `reach` around (x, y).

    The separating axes are those of the square and the normal of each edge; degenerate polygons are allowed.
    """
    for axis in range(2):
        centre = x if axis == 0 else y
        if polygon[:count, axis].min() > centre + reach or polygon[:count, axis].max() < centre - reach:
            return False
    for k in range(count):
        start, end = polygon[k], polygon[(k + 1) % count]
        normal_x, normal_y = end[1] - start[1], start[0] - end[0]
        half = reach * (abs(normal_x) + abs(normal_y))
        centre = normal_x * x + normal_y * y
        low, high = np.inf, -np.inf
        for corner in range(count):
            value = normal_x * polygon[corner, 0] + normal_y * polygon[corner, 1]
            low, high = min(low, value), max(high, value)
        if low > centre + half or high < centre - half:
            return False
    return True
