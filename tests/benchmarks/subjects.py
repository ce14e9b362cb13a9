"""Inputs of the benchmarks: configuration, scenes with a number of triangles, poses."""

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
"""Seed of all random numbers in the benchmarks."""


def config(cache_folder: str, *overrides: str, experiment: str = "chair_unet") -> DictConfig:
    """Compose the config of a training, at small scale by default."""
    paths = ["paths.run=.", f"paths.cache={cache_folder}"]
    return compose("train", [f"+experiment={experiment}", *paths, *overrides])


def observer(cache_folder: str, *overrides: str) -> Observer:
    """Return the observer of the composed config."""
    views: Observer = instantiate(config(cache_folder, *overrides).data.observer)
    return views


@cache
def procedural_scene(number: int = 0) -> Scene:
    """Return a procedural test scene."""
    return observer("unused").source.load(f"test_{number:04d}")


def scene_of_area(area: float, count: int = 8) -> Scene:
    """Return the one of the first test scenes whose floor area is closest to `area`, square metres."""
    return min(
        (procedural_scene(number) for number in range(count)), key=lambda scene: abs(floor_area(scene) - area)
    )


def floor_area(scene: Scene) -> float:
    """Return the area of the rectangle around the building, square metres."""
    building = scene.mesh.faces[scene.mesh.face_instance == 0]
    corners = scene.mesh.vertices[building].reshape(-1, 3)
    width, depth = (corners.max(axis=0) - corners.min(axis=0))[:2]
    return float(width * depth)


def with_triangles(mesh: Mesh, count: int) -> Mesh:
    """Return the same surfaces with at least `count` triangles.

    The largest triangles of the furniture are split into four repeatedly, since designed scenes have most triangles in
    their furniture.
    """
    while len(mesh.faces) < count:
        corners = mesh.vertices[mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        area[mesh.face_instance == 0] = 0
        furniture = int((mesh.face_instance > 0).sum())
        selected = np.argsort(-area, kind="stable")[: min(furniture, -(-(count - len(mesh.faces)) // 3))]
        mesh = _split(mesh, selected)
    return mesh


def _split(mesh: Mesh, selected: np.ndarray) -> Mesh:
    """Replace each selected face by four."""
    rest = np.setdiff1d(np.arange(len(mesh.faces)), selected)
    corners, uv = mesh.vertices[mesh.faces[selected]], mesh.face_uv[selected]

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
        face_instance=np.concatenate([mesh.face_instance[rest], np.tile(mesh.face_instance[selected], 4)]),
        face_material=np.concatenate([mesh.face_material[rest], np.tile(mesh.face_material[selected], 4)]),
        face_uv=np.concatenate([mesh.face_uv[rest], quarters(uv).astype(np.float32)]),
    )


def camera(size: int) -> Camera:
    """Return the robot's camera with square images of `size` pixels a side."""
    return Camera.from_degrees(size, size, 90.0, 1.25)


def poses(scene: Scene, count: int) -> list[Pose]:
    """Return random poses in a scene."""
    return sample_poses(scene.free_space, count, np.random.default_rng(SEED))
