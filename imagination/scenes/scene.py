"""The interfaces every scene source fulfils: Scene, and SceneSource that loads scenes by name."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from imagination.geometry.grid import Grid
from imagination.geometry.pose import Pose


@dataclass(frozen=True)
class OrientedBox:
    """A box that stands upright: only its yaw turns it.

    Attributes:
        centre: world x, y, z of the box's centre, metres.
        size: extents along the box's own x, y, z axes, metres.
        yaw: counter-clockwise angle of the box's x axis from world +x, radians.
    """

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float

    def footprint(self) -> Float[np.ndarray, "4 2"]:
        """World x, y of the four corners seen from above, counter-clockwise, metres."""
        half = np.array(self.size[:2]) / 2
        corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half
        return Pose(self.centre[0], self.centre[1], self.yaw).to_world(corners)


@dataclass(frozen=True)
class SceneObject:
    """One thing in a scene.

    Attributes:
        instance: its id in rendered images; 0 is the building itself (walls, floor, ceiling, doors, windows).
        label: what the scene source calls it, e.g. "armchair".
        category: its row in the category table, None if it belongs to none.
        box: where it is.
        model: which model or style it is, for reports of what a split contains.
    """

    instance: int
    label: str
    category: str | None
    box: OrientedBox
    model: str = ""


@dataclass(frozen=True)
class Material:
    """How faces look: a colour, multiplied by a texture if there is one.

    Attributes:
        colour: RGB, 0 to 1.
        texture: RGB image that repeats, or None. Texture coordinate (0, 0) is its lower-left corner, (1, 1) its
            upper-right.
    """

    colour: tuple[float, float, float]
    texture: UInt8[np.ndarray, "th tw 3"] | None = None


@dataclass(frozen=True)
class Mesh:
    """All triangles of a scene, z up, metres."""

    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    face_instance: Int32[np.ndarray, " m"]
    face_material: Int32[np.ndarray, " m"]
    face_uv: Float32[np.ndarray, "m 3 2"]
    materials: tuple[Material, ...]


@dataclass(frozen=True)
class Lighting:
    """Ambient light and directional lights without shadows; colours are RGB factors.

    Attributes:
        ambient: colour of light from everywhere.
        directions: unit vectors that point from the scene towards each light.
        colours: of each light.
    """

    ambient: tuple[float, float, float] = (0.45, 0.45, 0.45)
    directions: Float32[np.ndarray, "k 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    colours: Float32[np.ndarray, "k 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))


class FreeSpace(NamedTuple):
    """Where the robot's centre may stand: one connected part of the floor.

    Attributes:
        grid: cells of `mask`.
        mask: True where the robot stands clear of everything.
    """

    grid: Grid
    mask: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Scene:
    """One floor of one home.

    Attributes:
        name: unique within its source.
        mesh, lighting: what the renderer draws.
        objects: everything with an instance id except the building itself.
        free_space: where the robot may stand; never empty.
        floor_height: world z of the floor, metres.
        ceiling_height: world z of the ceiling, metres.
        renderer: what draws the scene instead of the ray caster (`renderer.SceneRenderer`); the mesh may then be empty.
    """

    name: str
    mesh: Mesh
    lighting: Lighting
    objects: tuple[SceneObject, ...]
    free_space: FreeSpace
    floor_height: float = 0.0
    ceiling_height: float = 2.6
    renderer: object = None

    def of_category(self, category: str) -> list[SceneObject]:
        """The objects of one category."""
        return [thing for thing in self.objects if thing.category == category]

    def category_of_instance(self, names: Sequence[str]) -> UInt8[np.ndarray, " n"]:
        """Lookup table from instance id to category index (position in `names` + 1; 0 for none)."""
        table = np.zeros(1 + max((thing.instance for thing in self.objects), default=0), np.uint8)
        for thing in self.objects:
            if thing.category is not None and thing.category in names:
                table[thing.instance] = names.index(thing.category) + 1
        return table
