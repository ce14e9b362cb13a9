"""Pieces made of parts in a local frame (x right, y front, z up, origin on the floor), and their placement."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.building_blocks.shapes import Point, Solid
from imagination.scenes.scene import Material


class Seat(NamedTuple):
    """Place for a chair at a table, in the frame of the table.

    Attributes:
        x, y: point on the edge of the table, metres.
        yaw: yaw of a chair that faces the table, radians.
        width: available width along the edge, metres.
        depth: maximum depth of a chair under the top, metres.
        underside: height of the lowest part above the chair, metres.
    """

    x: float
    y: float
    yaw: float
    width: float
    depth: float
    underside: float


class Surface(NamedTuple):
    """Horizontal rectangle for smaller objects, in the frame of a piece; metres."""

    x0: float
    y0: float
    x1: float
    y1: float
    z: float


@dataclass(frozen=True, eq=False)
class Piece:
    """Finished piece of furniture or building that can be placed any number of times.

    Attributes:
        label: label of the object, e.g. "armchair".
        model: family and style.
        vertices, faces, uv: triangles and their texture coordinates, metres.
        face_finish: index into `finishes` of each face.
        finishes: finishes of the faces.
        seats: places for chairs.
        surfaces: surfaces for smaller objects.
    """

    label: str
    model: str
    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    uv: Float[np.ndarray, "m 3 2"]
    face_finish: Int[np.ndarray, " m"]
    finishes: tuple[Finish, ...]
    seats: tuple[Seat, ...] = ()
    surfaces: tuple[Surface, ...] = ()

    @cached_property
    def low(self) -> Float[np.ndarray, "3"]:
        """Smallest x, y, z of the vertices, metres."""
        return np.asarray(self.vertices.min(axis=0))

    @cached_property
    def high(self) -> Float[np.ndarray, "3"]:
        """Largest x, y, z of the vertices, metres."""
        return np.asarray(self.vertices.max(axis=0))


@dataclass
class Assembly:
    """Builder that collects the parts of one piece."""

    label: str
    model: str = ""
    seats: list[Seat] = field(default_factory=list)
    surfaces: list[Surface] = field(default_factory=list)
    parts: list[tuple[Solid, Finish, Float[np.ndarray, "m 3 2"]]] = field(default_factory=list)

    def add(
        self,
        solid: Solid,
        finish: Finish,
        at: Point = (0.0, 0.0, 0.0),
        yaw: float = 0.0,
        tilt: float = 0.0,
        whole: bool = False,
    ) -> None:
        """Add a part, tilted, turned and moved after texture mapping, so that the grain follows the part.

        With `whole` one texture tile covers each side of the part, whatever its size.
        """
        if whole:
            low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
            uv = (
                box_uv(Solid((solid.vertices - low) / np.maximum(high - low, 1e-6), solid.faces))
                * finish.tile
            )
        else:
            # parts have different texture offsets, otherwise neighbouring boards would be identical
            uv = box_uv(solid) + 0.37 * len(self.parts)
        self.parts.append((solid.moved(at, yaw, tilt), finish, uv))

    def turn(self, yaw: float) -> None:
        """Rotate all parts added so far about z."""
        self.parts = [(solid.moved(yaw=yaw), finish, uv) for solid, finish, uv in self.parts]

    def finished(self) -> Piece:
        """Return the piece made of all parts added."""
        solids = [solid for solid, _, _ in self.parts]
        finishes = list({id(finish): finish for _, finish, _ in self.parts}.values())
        rows = {id(finish): number for number, finish in enumerate(finishes)}
        starts = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
        return Piece(
            self.label,
            self.model,
            np.concatenate([solid.vertices for solid in solids]),
            np.concatenate([solid.faces + start for solid, start in zip(solids, starts[:-1], strict=True)]),
            np.concatenate([uv for _, _, uv in self.parts]),
            np.repeat(
                [rows[id(finish)] for _, finish, _ in self.parts], [len(solid.faces) for solid in solids]
            ),
            tuple(finishes),
            tuple(self.seats),
            tuple(self.surfaces),
        )


def plain_piece(label: str, solid: Solid, colour: tuple[float, float, float]) -> Piece:
    """Return a piece that is a single solid of one colour, RGB from 0 to 1."""
    assembly = Assembly(label)
    assembly.add(solid, Finish(Material(colour)))
    return assembly.finished()


def box_uv(solid: Solid) -> Float[np.ndarray, "m 3 2"]:
    """Return box-mapped texture coordinates in metres: each face is projected along the main axis of its normal.

    The v axis of the texture, the direction of wood grain, is z on vertical faces and x on horizontal faces.
    """
    corners = solid.vertices[solid.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    planes = np.array([[1, 2], [0, 2], [1, 0]])[np.abs(normal).argmax(axis=1)]
    return np.take_along_axis(corners, np.broadcast_to(planes[:, None, :], (len(corners), 3, 2)), axis=2)


@dataclass(frozen=True, eq=False)
class Placed:
    """Placed piece: x, y, z of its origin in metres and its yaw in radians."""

    piece: Piece
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    z: float = 0.0

    def within(self, x: float, y: float, yaw: float, z: float = 0.0) -> "Placed":
        """Return the piece with its pose transformed from a frame at (x, y, z) and `yaw` to the parent frame."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        return Placed(
            self.piece,
            float(x + cos * self.x - sin * self.y),
            float(y + sin * self.x + cos * self.y),
            self.yaw + yaw,
            self.z + z,
        )

    def footprint(self, margin: float = 0.0) -> Float[np.ndarray, "4 2"]:
        """Return the corners of the bounding box seen from above, counter-clockwise, dilated by `margin` metres."""
        return rectangle_at(
            self.piece.low[:2] - margin, self.piece.high[:2] + margin, self.x, self.y, self.yaw
        )

    def points(self) -> Float[np.ndarray, "n 3"]:
        """Return the vertices of the placed piece."""
        return Solid(self.piece.vertices, self.piece.faces).moved((self.x, self.y, self.z), self.yaw).vertices


def rectangle_at(
    low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray, x: float, y: float, yaw: float
) -> Float[np.ndarray, "4 2"]:
    """Return the corners of the rectangle from `low` to `high`, rotated by `yaw` and moved to (x, y)."""
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.asarray(corners @ np.array([[cos, sin], [-sin, cos]]) + [x, y])
