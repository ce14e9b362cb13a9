"""Projection of depth images into maps: occupied cells, seen cells, categories (docs/concepts/conventions.md).

The depth return d at pixel centre (u + 0.5, v + 0.5) has the map coordinates
(row, column, height) = d * rays @ (u + 0.5, v + 0.5, 1) + offset, with rows and columns in cells (integers are cell
centres) and the height above the floor in metres. This affine map serves egocentric and global grids. Coordinates are
computed in float64, so that the cell of a return does not depend on the origin of the map.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.utils.errors import UserError, check_range
from imagination.utils.jit import compiled


class Band(NamedTuple):
    """Interval of heights above the floor, both ends included, metres."""

    low: float
    high: float


class EgoView(NamedTuple):
    """Egocentric maps of one depth image.

    Attributes:
        occupied: cells with a depth return inside the obstacle band.
        seen: V_seen, the observed cells.
    """

    occupied: Bool[np.ndarray, "v v"]
    seen: Bool[np.ndarray, "v v"]


class _Placement(NamedTuple):
    """Affine map from pixels and depth to (row, column, height); see the module docstring."""

    rays: Float64[np.ndarray, "3 3"]
    offset: Float64[np.ndarray, "3"]


def validate_depth(depth: np.ndarray, camera: Camera) -> None:
    """Check that an array is a depth image of the camera.

    Raises:
        UserError: if the shape or type is wrong, or a value is NaN, infinite or negative.
    """
    if depth.shape != (camera.height, camera.width):
        raise UserError(
            f"depth: got shape {depth.shape}, expected {(camera.height, camera.width)}, the size of the camera image"
        )
    if depth.dtype != np.float32:
        raise UserError(f"depth: got {depth.dtype}, expected float32 (metres); convert the array")
    low, high = depth.min(), depth.max()
    if not (low >= 0 and high < np.inf):  # also refuses NaN, which compares false
        invalid = depth[~((depth >= 0) & (depth < np.inf))]
        raise UserError(
            f"depth: got {invalid[0]} in {invalid.size} of {depth.size} pixels, expected finite metres, "
            "0 where there is no return; replace NaN, infinity and negative values by 0"
        )


def project_depth(
    depth: Float32[np.ndarray, "h w"],
    camera: Camera,
    grid: EgoGrid,
    obstacles: Band,
    max_range: float = np.inf,
) -> EgoView:
    """Project one depth image into egocentric maps of occupied and seen cells (V_seen).

    A cell is occupied if it contains a depth return between `obstacles.low` and `obstacles.high`. A cell is seen if it
    contains a return up to `obstacles.high`, or if it is between two vertically adjacent returns of one image column
    that are both floor (below `obstacles.low`). An image column is one pixel wide, so the visible floor has no gaps at
    any image resolution. A ray that passes above a cell does not observe it.

    Args:
        depth: depth along the optical axis, metres; 0 where there is no return.
        camera: camera of the image.
        grid: grid of the result.
        obstacles: heights of obstacles.
        max_range: maximum depth of the returns, metres.

    Raises:
        UserError: if the depth, the band or the range is invalid.
    """
    validate_depth(depth, camera)
    _check_limits(obstacles, max_range)
    placement = _place(camera, camera.to_robot(), _robot_to_cells(grid))
    occupied, seen = np.zeros((2, grid.cells, grid.cells), np.bool_)
    _observe(depth, *placement, obstacles.low, obstacles.high, max_range, occupied, seen)
    return EgoView(occupied, seen)


def project_categories(
    depth: Float32[np.ndarray, "h w"],
    categories: UInt8[np.ndarray, "h w"],
    camera: Camera,
    grid: EgoGrid,
    count: int,
    band: Band,
    max_range: float = np.inf,
) -> Bool[np.ndarray, "{count} v v"]:
    """Project a segmented depth image into one egocentric map of each category.

    Args:
        depth: depth along the optical axis, metres; 0 where there is no return.
        categories: category of each pixel; 0 is background, k belongs to layer k - 1.
        camera: camera of the image.
        grid: grid of the result.
        count: number of categories.
        band: heights of the returns that are projected.
        max_range: maximum depth of the returns, metres.

    Raises:
        UserError: if the depth, a category, the band or the range is invalid.
    """
    validate_depth(depth, camera)
    _check_limits(band, max_range)
    if categories.shape != depth.shape or categories.max() > count:
        raise UserError(
            f"categories: got shape {categories.shape} and indices up to {categories.max()}, "
            f"expected shape {depth.shape} and indices up to {count}"
        )
    out = np.zeros((count, grid.cells, grid.cells), np.bool_)
    placement = _place(camera, camera.to_robot(), _robot_to_cells(grid))
    _mark(depth, categories, *placement, band.low, band.high, max_range, out)
    return out


def splat(
    depth: Float32[np.ndarray, "h w"],
    camera: Camera,
    camera_to_world: Float[np.ndarray, "4 4"],
    floor_height: float,
    band: Band,
    grid: Grid,
    out: Bool[np.ndarray, "rows columns"],
    max_range: float = np.inf,
    select: Bool[np.ndarray, "h w"] | None = None,
) -> None:
    """Project one depth image into the global map `out`, in place, for a camera in any pose; marked cells stay marked.

    Args:
        depth: depth along the optical axis, metres; 0 where there is no return.
        camera: camera of the image.
        camera_to_world: transform from the optical frame to the world frame.
        floor_height: world z of the floor, metres; `band` is measured from it.
        band: heights above the floor of the returns that are projected.
        grid: grid of `out`.
        out: map that is changed in place.
        max_range: maximum depth of the returns, metres.
        select: mask of the pixels that are projected; all if None.

    Raises:
        UserError: if the depth, the pose, a shape, the band or the range is invalid.
    """
    validate_depth(depth, camera)
    _check_limits(band, max_range)
    if not np.isfinite(camera_to_world).all():
        raise UserError(f"camera_to_world: got {camera_to_world.tolist()}, expected finite numbers")
    if out.shape != grid.shape or (select is not None and select.shape != depth.shape):
        shapes = out.shape, None if select is None else select.shape
        raise UserError(f"out and select: got shapes {shapes}, expected {grid.shape} and {depth.shape}")
    world_to_cells = np.array(
        [
            [0.0, -1 / grid.resolution, 0.0, grid.rows - 0.5 + grid.origin[1] / grid.resolution],
            [1 / grid.resolution, 0.0, 0.0, -0.5 - grid.origin[0] / grid.resolution],
            [0.0, 0.0, 1.0, -floor_height],
        ]
    )
    placement = _place(camera, np.asarray(camera_to_world, np.float64), world_to_cells)
    labels = np.ones(depth.shape, np.uint8) if select is None else select.view(np.uint8)
    _mark(depth, labels, *placement, band.low, band.high, max_range, out[None])


def _check_limits(band: Band, max_range: float) -> None:
    if not band.low < band.high:
        raise UserError(f"band: got {band.low} to {band.high} m, expected low < high")
    check_range("max_range", max_range, 0.0, np.inf, "m", open_low=True)


def _robot_to_cells(grid: EgoGrid) -> Float64[np.ndarray, "3 4"]:
    """Return the affine map from the robot frame to (row, column, height), as in `EgoGrid.to_cells`."""
    scale = -1 / grid.resolution
    return np.array(
        [[scale, 0.0, 0.0, grid.cells - 1], [0.0, scale, 0.0, grid.cells // 2], [0.0, 0.0, 1.0, 0.0]]
    )


def _place(
    camera: Camera, camera_to_frame: Float64[np.ndarray, "4 4"], frame_to_cells: Float64[np.ndarray, "3 4"]
) -> _Placement:
    """Return the affine map from pixels and depth to (row, column, height) for one camera pose."""
    focal, (centre_x, centre_y) = camera.focal_length, camera.principal_point
    pixels_to_rays = np.array(
        [[1 / focal, 0.0, -centre_x / focal], [0.0, 1 / focal, -centre_y / focal], [0.0, 0.0, 1.0]]
    )
    camera_to_cells = frame_to_cells @ camera_to_frame
    return _Placement(camera_to_cells[:, :3] @ pixels_to_rays, camera_to_cells[:, 3].copy())


@compiled
def _mark(
    depth: Float32[np.ndarray, "h w"],
    labels: UInt8[np.ndarray, "h w"],
    rays: Float64[np.ndarray, "3 3"],
    offset: Float64[np.ndarray, "3"],
    low: float,
    high: float,
    max_range: float,
    out: Bool[np.ndarray, "c rows columns"],
) -> None:
    """Mark the cell of each return inside the band, in the layer of its label; skip label 0."""
    layers, rows, columns = out.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            d, label = depth[v, u], labels[v, u]
            if label == 0 or not 0.0 < d <= max_range:
                continue
            x, y = u + 0.5, v + 0.5
            z = d * (rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]) + offset[2]
            if not low <= z <= high:
                continue
            row = np.floor(d * (rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]) + offset[0] + 0.5)
            column = np.floor(d * (rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]) + offset[1] + 0.5)
            if 0 <= row < rows and 0 <= column < columns:
                out[label - 1, int(row), int(column)] = True


@compiled
def _observe(
    depth: Float32[np.ndarray, "h w"],
    rays: Float64[np.ndarray, "3 3"],
    offset: Float64[np.ndarray, "3"],
    low: float,
    high: float,
    max_range: float,
    occupied: Bool[np.ndarray, "v v"],
    seen: Bool[np.ndarray, "v v"],
) -> None:
    """Mark occupied and seen cells; scan each image column downwards and keep the floor return one pixel above."""
    cells = seen.shape[0]
    # offset from the centre of a pixel to its right edge, at depth 1
    half_row, half_column = rays[0, 0] / 2, rays[1, 0] / 2
    for u in range(depth.shape[1]):
        # depth (0 if there is none) and position of the floor return one pixel above
        above, row_above, column_above = 0.0, 0.0, 0.0
        for v in range(depth.shape[0]):
            d, x, y = depth[v, u], u + 0.5, v + 0.5
            z = d * (rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]) + offset[2]
            if not 0.0 < d <= max_range or z > high:
                above = 0.0
                continue
            row = d * (rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]) + offset[0]
            column = d * (rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]) + offset[1]
            if -0.5 <= row < cells - 0.5 and -0.5 <= column < cells - 0.5:
                r, c = int(np.floor(row + 0.5)), int(np.floor(column + 0.5))
                seen[r, c] = True
                occupied[r, c] |= z >= low
            if z >= low:
                above = 0.0
                continue
            if above > 0.0:
                dr, dc, er, ec = d * half_row, d * half_column, above * half_row, above * half_column
                _fill(
                    seen,
                    (row - dr, row + dr, row_above + er, row_above - er),
                    (column - dc, column + dc, column_above + ec, column_above - ec),
                )
            above, row_above, column_above = d, row, column


@compiled
def _fill(
    seen: Bool[np.ndarray, "v v"],
    rows: tuple[float, float, float, float],
    columns: tuple[float, float, float, float],
) -> None:
    """Mark the cells that a convex quadrilateral touches on the centre line of each row of cells."""
    cells = seen.shape[0]
    first = max(np.ceil(min(rows)), 0.0)
    last = min(np.floor(max(rows)), cells - 1.0)
    if first > last:
        return
    for row in range(int(first), int(last) + 1):
        left, right = np.inf, -np.inf
        for k in range(4):
            r0, r1, c0, c1 = rows[k], rows[k - 3], columns[k], columns[k - 3]
            if r0 == r1 == row:
                left, right = min(left, c0, c1), max(right, c0, c1)
            elif min(r0, r1) <= row <= max(r0, r1):
                c = c0 + (c1 - c0) * ((row - r0) / (r1 - r0))
                left, right = min(left, c), max(right, c)
        if right >= -0.5 and left < cells - 0.5:
            first_column = int(max(np.floor(left + 0.5), 0.0))
            last_column = int(min(np.floor(right + 0.5), cells - 1.0))
            seen[row, first_column : last_column + 1] = True
