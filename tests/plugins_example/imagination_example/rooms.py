"""A scene source: rectangular rooms, each with one seat in its middle."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from imagination.errors import check_choice
from imagination.scenes.free_space import free_space
from imagination.scenes.scene import Lighting, Material, Mesh, OrientedBox, Scene, SceneObject, Split

SEAT = (0.5, 0.5, 0.8)
HEIGHT = 2.6


@dataclass(frozen=True)
class BoxRooms:
    """Rooms of 4 m by 4 m and more; the seat's label is "seat".

    Attributes:
        homes: number of rooms in each split.
        robot_radius: metres.
    """

    homes: Mapping[str, int]
    robot_radius: float
    name: str = "box_rooms"

    def scenes(self, split: Split) -> list[str]:
        return [f"{split}_{number}" for number in range(self.homes[split])]

    def load(self, scene: str) -> Scene:
        check_choice(
            "scene", scene, [name for split in ("train", "val", "test") for name in self.scenes(split)]
        )
        side = 4.0 + 0.5 * int(scene.rpartition("_")[2])
        room = _box((0.0, 0.0, HEIGHT / 2), (side, side, HEIGHT))[:, ::-1]  # seen from inside
        mesh = _mesh([room, _box((0.0, 0.0, SEAT[2] / 2), SEAT)])
        seat = SceneObject(1, "seat", "chair", OrientedBox((0.0, 0.0, SEAT[2] / 2), SEAT, 0.0), "cube")
        return Scene(scene, mesh, Lighting(), (seat,), free_space(mesh, 0.0, self.robot_radius))

    def fingerprint(self, scene: str) -> str:
        return f"box rooms 1 {scene} {self.robot_radius}"


def _box(centre: tuple[float, float, float], size: tuple[float, float, float]) -> np.ndarray:
    """The 12 triangles of a box with normals outwards: (12, 3, 3)."""
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            corner = np.zeros((4, 3))
            corner[:, axis] = sign
            corner[:, (axis + 1) % 3] = np.array([-1, 1, 1, -1])
            corner[:, (axis + 2) % 3] = np.array([-1, -1, 1, 1]) * sign
            sides.append(corner[[[0, 1, 2], [0, 2, 3]]])
    return np.array(sides).reshape(12, 3, 3) * np.array(size) / 2 + np.array(centre)


def _mesh(boxes: list[np.ndarray]) -> Mesh:
    triangles = np.concatenate(boxes).astype(np.float32)
    owner = np.repeat(np.arange(len(boxes), dtype=np.int32), 12)
    faces = np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)
    materials = (Material((0.8, 0.8, 0.7)), Material((0.7, 0.2, 0.2)))
    return Mesh(
        triangles.reshape(-1, 3), faces, owner, owner, np.zeros((len(faces), 3, 2), np.float32), materials
    )
