"""Data classes of a scene: mesh, materials, lighting, objects and free space."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from imagination.geometry.grid import Grid
from imagination.geometry.pose import Pose


@dataclass(frozen=True)
class OrientedBox:
    """Upright box with a yaw angle.

    Attributes:
        centre: world x, y, z of the box's centre, metres.
        size: extents along the x, y, z axes of the box, metres.
        yaw: counter-clockwise angle of the box's x axis from world +x, radians.
    """

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float

    def footprint(self) -> Float[np.ndarray, "4 2"]:
        """Return the world x, y of the four corners seen from above, counter-clockwise, metres."""
        half = np.array(self.size[:2]) / 2
        corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half
        return Pose(self.centre[0], self.centre[1], self.yaw).to_world(corners)


@dataclass(frozen=True)
class SceneObject:
    """Object in a scene.

    Attributes:
        instance: id in rendered images; 0 is the building (walls, floor, ceiling, doors, windows).
        label: label in the scene source, e.g. "armchair".
        category: name of the category in the category table, or None.
        box: bounding box.
        model: model or style, for reports of the content of a split.
    """

    instance: int
    label: str
    category: str | None
    box: OrientedBox
    model: str = ""


@dataclass(frozen=True)
class Material:
    """Material of faces: a colour that multiplies an optional texture.

    Attributes:
        colour: RGB colour, 0 to 1.
        texture: repeating RGB image, or None. Texture coordinate (0, 0) is its lower-left, (1, 1) its upper-right
            corner.
    """

    colour: tuple[float, float, float]
    texture: UInt8[np.ndarray, "th tw 3"] | None = None


@dataclass(frozen=True)
class Mesh:
    """Triangle mesh of a scene, z up, metres."""

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
        ambient: colour of the ambient light.
        directions: unit vectors that point from the scene towards each light.
        colours: colour of each light.
    """

    ambient: tuple[float, float, float] = (0.45, 0.45, 0.45)
    directions: Float32[np.ndarray, "k 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    colours: Float32[np.ndarray, "k 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))


class FreeSpace(NamedTuple):
    """Free space of the robot centre: one connected part of the floor.

    Attributes:
        grid: grid of `mask`.
        mask: True where the robot does not collide.
    """

    grid: Grid
    mask: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Scene:
    """One storey of a building with its objects.

    Attributes:
        name: name, unique within its source.
        mesh, lighting: input of the ray caster.
        objects: objects with an instance id, without the building.
        free_space: free space of the robot; never empty.
        floor_height: world z of the floor, metres.
        ceiling_height: world z of the ceiling, metres.
        renderer: renderer used instead of the ray caster (a `renderer.SceneRenderer`); the mesh may then be empty.
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
        """Return the objects of one category."""
        return [obj for obj in self.objects if obj.category == category]

    def category_of_instance(self, names: Sequence[str]) -> UInt8[np.ndarray, " n"]:
        """Return the lookup table from instance id to category index (position in `names` + 1; 0 is background)."""
        table = np.zeros(1 + max((obj.instance for obj in self.objects), default=0), np.uint8)
        for obj in self.objects:
            if obj.category is not None and obj.category in names:
                table[obj.instance] = names.index(obj.category) + 1
        return table
