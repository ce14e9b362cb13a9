"""Closed triangle meshes for furniture; the corners of every face run counter-clockwise as seen from outside."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

Point = Sequence[float | int] | Float[np.ndarray, "3"]
Outline = Float[np.ndarray, "n 2"]


class Solid(NamedTuple):
    """Closed surface: vertices in metres and triangles as rows of three vertex indices."""

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]

    def moved(self, at: Point = (0.0, 0.0, 0.0), yaw: float = 0.0, tilt: float = 0.0) -> "Solid":
        """Return the shape tilted about x (positive tilts the top to -y), rotated about z, then translated."""
        cos_t, sin_t, cos_y, sin_y = np.cos(tilt), np.sin(tilt), np.cos(yaw), np.sin(yaw)
        tilt_matrix = np.array([[1.0, 0.0, 0.0], [0.0, cos_t, -sin_t], [0.0, sin_t, cos_t]])
        yaw_matrix = np.array([[cos_y, -sin_y, 0.0], [sin_y, cos_y, 0.0], [0.0, 0.0, 1.0]])
        return Solid(self.vertices @ (yaw_matrix @ tilt_matrix).T + np.asarray(at, np.float64), self.faces)


def _bands(rings: int, around: int) -> Int[np.ndarray, "m 3"]:
    """Return the triangles between successive closed counter-clockwise rings of `around` vertices, bottom to top."""
    ring, step = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    low, low_next = ring * around + step, ring * around + (step + 1) % around
    quads = np.stack([low, low_next, low_next + around, low + around], axis=-1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def loft(rings: Float[np.ndarray, "k n 3"]) -> Solid:
    """Return the surface through `k` rings of `n` points, with ends closed by fans around their mean points."""
    count, around = rings.shape[:2]
    ends = np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    vertices = np.concatenate([rings.reshape(-1, 3), ends])
    step = np.arange(around)
    after, last = (step + 1) % around, (count - 1) * around
    bottom = np.stack([after, step, np.full(around, count * around)], axis=-1)
    top = np.stack([last + step, last + after, np.full(around, count * around + 1)], axis=-1)
    return Solid(vertices, np.concatenate([_bands(count, around), bottom, top]))


def prism(outline: Outline, low: float, high: float) -> Solid:
    """Extrude an outline (counter-clockwise, star-shaped about its mean point) from height `low` to `high`."""
    return loft(np.stack([np.column_stack([outline, np.full(len(outline), z)]) for z in (low, high)]))


def rectangle(width: float, depth: float) -> Outline:
    """Return the outline of a rectangle centred on the origin."""
    return np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * [width / 2, depth / 2]


def ellipse(width: float, depth: float, segments: int = 32) -> Outline:
    """Return the outline of an ellipse centred on the origin."""
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    return np.column_stack([np.cos(angle) * width / 2, np.sin(angle) * depth / 2])


def rounded(width: float, depth: float, radius: float, segments: int = 4) -> Outline:
    """Return the outline of a rectangle with rounded corners, centred on the origin."""
    quarter = np.linspace(0, np.pi / 2, segments + 1)
    corners = [((1, -1), -np.pi / 2), ((1, 1), 0.0), ((-1, 1), np.pi / 2), ((-1, -1), np.pi)]
    reach = np.array([width / 2 - radius, depth / 2 - radius])
    arcs = [
        np.array(sign) * reach + radius * np.column_stack([np.cos(quarter + turn), np.sin(quarter + turn)])
        for sign, turn in corners
    ]
    return np.concatenate(arcs)


def box(width: float, depth: float, height: float) -> Solid:
    """Return a box with its base centred on the origin."""
    x, y = width / 2, depth / 2
    vertices = np.array(
        [[sx * x, sy * y, z] for z in (0.0, height) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    quads = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    return Solid(vertices, np.array([half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))]))


def cushion(
    width: float, depth: float, height: float, radius: float, puff: float = 0.0, steps: int = 2
) -> Solid:
    """Return a box with rounded edges, its base centred on the origin, whose top bulges by `puff` metres."""
    half = np.array([width, depth, height]) / 2
    radius = min(radius, *(half * 0.98))
    arc = radius * np.tan(np.linspace(np.pi / 4, 0, steps + 1))
    axes = []
    for reach in half:
        inner = reach - radius
        middle = np.linspace(-inner, inner, 5)[1:-1] if puff else np.zeros(0)
        axes.append(np.concatenate([-inner - arc, middle, inner + arc[::-1]]))
    vertices, faces, start = [], [], 0
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        a, b = np.meshgrid(axes[first], axes[second], indexing="ij")
        rows, columns = a.shape
        i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
        corner = (i * columns + j).ravel()
        quads = np.stack([corner, corner + columns, corner + columns + 1, corner + 1], axis=-1)
        for sign in (1.0, -1.0):
            points = np.zeros((rows * columns, 3))
            points[:, axis], points[:, first], points[:, second] = sign * half[axis], a.ravel(), b.ravel()
            core = np.clip(points, -(half - radius), half - radius)
            outward = points - core
            points = core + radius * outward / np.linalg.norm(outward, axis=1, keepdims=True)
            turned = quads if sign > 0 else quads[:, ::-1]
            vertices.append(points)
            faces += [start + turned[:, [0, 1, 2]], start + turned[:, [0, 2, 3]]]
            start += len(points)
    merged = np.concatenate(vertices)
    bulge = (1 - (merged[:, 0] / half[0]) ** 2) * (1 - (merged[:, 1] / half[1]) ** 2) * (merged[:, 2] > 0)
    merged[:, 2] += half[2] + puff * bulge
    return Solid(merged, np.concatenate(faces))


def lathe(profile: Sequence[tuple[float, float]], segments: int = 20) -> Solid:
    """Return the surface of revolution about z of a profile of (radius, height) pairs, bottom to top."""
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(segments)])
    return loft(np.stack([circle * radius + [0.0, 0.0, height] for radius, height in profile]))


def tube(path: Sequence[Point], radius: float | Sequence[float], sides: int = 8) -> Solid:
    """Return a round bar along a path of points; `radius` may have one value for each point, for tapered legs."""
    points = np.asarray(path, np.float64)
    ahead = np.diff(points, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    tangent = np.concatenate([ahead[:1], ahead[:-1] + ahead[1:], ahead[-1:]])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent[0], [0.0, 1.0, 0.0] if abs(tangent[0][1]) < 0.9 else [1.0, 0.0, 0.0])
    # half a step of rotation aligns the faces of four-sided bars with the axes
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False) + np.pi / sides
    radii = np.broadcast_to(np.asarray(radius, np.float64), len(points))
    rings = []
    for point, direction, reach in zip(points, tangent, radii, strict=True):
        # parallel transport along the path, so that the bar does not twist
        side = side - (side @ direction) * direction
        side /= np.linalg.norm(side)
        across = np.cross(direction, side)
        rings.append(point + reach * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * across))
    return loft(np.stack(rings))


def bent(corners: Sequence[Point], radius: float, segments: int = 4) -> list[Float[np.ndarray, "3"]]:
    """Return the path through `corners` with rounded inner corners, for tubes."""
    points = [np.asarray(corner, np.float64) for corner in corners]
    path = [points[0]]
    for before, corner, after in zip(points, points[1:], points[2:], strict=False):
        reach = min(radius, *(float(np.linalg.norm(end - corner)) / 2.01 for end in (before, after)))
        start = corner + reach * (before - corner) / np.linalg.norm(before - corner)
        stop = corner + reach * (after - corner) / np.linalg.norm(after - corner)
        t = np.linspace(0, 1, segments + 1)[:, None]
        path += list((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * stop)
    return [*path, points[-1]]


def sheet(points: Float[np.ndarray, "r c 3"], thickness: float) -> Solid:
    """Return a curved board with a grid of points as front and its back `thickness` behind, along -(d_c x d_r)."""
    across = np.gradient(points, axis=1)
    along = np.gradient(points, axis=0)
    normal = np.cross(across, along)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    # each row becomes a ring: along the front, then back along the rear
    rows, columns = points.shape[:2]
    rings = np.concatenate([points, (points - thickness * normal)[:, ::-1]], axis=1)
    # strips between front and rear close the first and last ring, also for curved rows
    front = np.arange(columns - 1)
    rear = 2 * columns - 1 - front
    rim = np.stack([front + 1, front, rear, rear - 1], axis=-1)
    quads = np.concatenate([rim, rim[:, ::-1] + (rows - 1) * 2 * columns])
    faces = np.concatenate([_bands(rows, 2 * columns), quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Solid(rings.reshape(-1, 3), faces)
