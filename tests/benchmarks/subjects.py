"""What is measured: scenes with so many triangles, views, the small's configuration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig

from imagination.config.compose import compose
from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose
from imagination.scenes.scene import Mesh, Scene
from imagination.views.observer import Observer
from imagination.views.pose_samplers import sample_poses

SEED = 0
"""Of everything drawn at random here."""


def config(cache_folder: str, *overrides: str, experiment: str = "chair_unet") -> DictConfig:
    """A run's config as the command composes it."""
    paths = ["paths.run=.", f"paths.cache={cache_folder}"]
    return compose("train", [f"+experiment={experiment}", *paths, *overrides])


def observer(cache_folder: str, *overrides: str) -> Observer:
    """What a view looks like at that scale."""
    made: Observer = instantiate(config(cache_folder, *overrides).data.observer)
    return made


@cache
def procedural_scene(number: int = 0) -> Scene:
    """A procedural test scene."""
    return observer("unused").source.load(f"test_{number:04d}")


def home_of(area: float, tried: int = 8) -> Scene:
    """Of the first few test scenes, the one whose walls enclose nearest to `area` square metres."""
    return min(
        (procedural_scene(number) for number in range(tried)), key=lambda scene: abs(floor_area(scene) - area)
    )


def floor_area(scene: Scene) -> float:
    """Of the rectangle around the building, square metres."""
    building = scene.mesh.faces[scene.mesh.face_instance == 0]
    corners = scene.mesh.vertices[building].reshape(-1, 3)
    width, depth = (corners.max(axis=0) - corners.min(axis=0))[:2]
    return float(width * depth)


def with_triangles(mesh: Mesh, count: int) -> Mesh:
    """The same surfaces with at least `count` triangles: the furniture's largest are split into four, again and again.

    Furniture, since that is where designed scenes have theirs.
    """
    while len(mesh.faces) < count:
        corners = mesh.vertices[mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        area[mesh.face_instance == 0] = 0
        furniture = int((mesh.face_instance > 0).sum())
        chosen = np.argsort(-area, kind="stable")[: min(furniture, -(-(count - len(mesh.faces)) // 3))]
        mesh = _split(mesh, chosen)
    return mesh


def _split(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    """The mesh with each chosen face replaced by four."""
    rest = np.setdiff1d(np.arange(len(mesh.faces)), chosen)
    corners, uv = mesh.vertices[mesh.faces[chosen]], mesh.face_uv[chosen]

    def quarters(points: np.ndarray) -> np.ndarray:
        a, b, c = points[:, 0], points[:, 1], points[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        return np.concatenate([np.stack(part, axis=1) for part in parts])

    new = quarters(corners)
    faces = len(mesh.vertices) + np.arange(3 * len(new), dtype=np.int32).reshape(-1, 3)
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, new.reshape(-1, 3).astype(np.float32)]),
        faces=np.concatenate([mesh.faces[rest], faces]).astype(np.int32),
        face_instance=np.concatenate([mesh.face_instance[rest], np.tile(mesh.face_instance[chosen], 4)]),
        face_material=np.concatenate([mesh.face_material[rest], np.tile(mesh.face_material[chosen], 4)]),
        face_uv=np.concatenate([mesh.face_uv[rest], quarters(uv).astype(np.float32)]),
    )


def camera(size: int) -> Camera:
    """The robot's, with square images of `size` pixels."""
    return Camera.from_degrees(size, size, 90.0, 1.25)


def poses(scene: Scene, count: int) -> list[Pose]:
    """Random poses in a scene."""
    return sample_poses(scene.free_space, count, np.random.default_rng(SEED))
