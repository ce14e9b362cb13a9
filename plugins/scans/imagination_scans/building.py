"""A scanned building as its files have it, and its floors as scenes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from imagination.scenes.scene import Material, Mesh, OrientedBox
from imagination.utils.errors import UserError

FLAT = 0.95
"""Least vertical share of the unit normal of floors and ceilings."""
BIN = 0.05
"""Heights are told apart by so much, metres."""
STOREY = 1.9
"""Least height between two floors, metres."""
FLOOR_AREA, FLOOR_SHARE = 3.0, 0.2
"""Least area of a floor, m2, and its least share of the largest floor's."""
CEILING = 2.6
"""Height of the ceiling where the scan has none, metres."""
BELOW = 0.3
"""What lies so far under the floor or over the ceiling still belongs to it, metres."""


GREY = 180
"""Of each channel where the scan has no colour."""
MAX_ID = 2**31 - 1
"""Ids of objects are less."""


@dataclass(frozen=True)
class ScannedObject:
    """An object as annotated: its id in the mesh (from 1), its name, the corners of its box if it has one."""

    id: int
    name: str
    corners: Float[np.ndarray, "8 3"] | None = None


@dataclass(frozen=True)
class Building:
    """Triangles, z up, metres; `face_object` is an object's id, 0 for none."""

    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    face_object: Int32[np.ndarray, " m"]
    face_material: Int32[np.ndarray, " m"]
    face_uv: Float32[np.ndarray, "m 3 2"]
    materials: tuple[Material, ...]
    objects: tuple[ScannedObject, ...]


class Floor(NamedTuple):
    """Heights of a floor and its ceiling, metres."""

    height: float
    ceiling: float


def check_building(building: Building, where: str) -> None:
    """Refuse a building without semantics.

    Raises:
        UserError: with what was found.
    """
    if len(building.faces) == 0:
        raise UserError(f"{where}: its mesh has no faces")
    if not building.objects:
        raise UserError(f"{where}: lists no objects, expected some with names; its semantics are empty")
    seen = set(np.unique(building.face_object).tolist())
    ids = [obj.id for obj in building.objects]
    if min(ids) < 1 or len(set(ids)) < len(ids):
        raise UserError(f"{where}: ids of its objects are below 1 or occur twice: {sorted(ids)[:5]} …")
    if not seen & set(ids):
        raise UserError(
            f"{where}: none of its {len(building.objects)} objects has a face in the mesh (ids there: "
            f"{sorted(seen)[:5]} …); mesh and annotation do not belong together"
        )


def coloured(
    rgb: UInt8[np.ndarray, "m 3"],
) -> tuple[tuple[Material, ...], Int32[np.ndarray, " m"], Float32[np.ndarray, "m 3 2"]]:
    """Materials, rows and texture coordinates that give each face one colour, of 32 levels a channel.

    One texture holds every colour and each face points to the middle of one texel: a material a colour would be many.
    """
    levels = np.arange(32) * 255 // 31
    red, green, blue = np.meshgrid(levels, levels, levels, indexing="ij")
    palette = np.stack([red, green, blue], axis=-1).reshape(128, 256, 3).astype(np.uint8)
    index = ((rgb >> 3).astype(np.int64) * [1024, 32, 1]).sum(axis=1)
    u, v = (index % 256 + 0.5) / 256, 1 - (index // 256 + 0.5) / 128
    uv = np.repeat(np.stack([u, v], axis=-1)[:, None].astype(np.float32), 3, axis=1)
    return (Material((1.0, 1.0, 1.0), palette),), np.zeros(len(rgb), np.int32), uv


def floors_of(building: Building) -> list[Floor]:
    """The floors, lowest first: heights with the most level area that faces up, a storey apart.

    Raises:
        UserError: if nothing of the mesh is level and faces up.
    """
    corners = building.vertices[building.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    share = normal[:, 2] / np.maximum(area, 1e-12)
    z = corners[..., 2].mean(axis=1)
    up, down = _areas(z, area / 2, share > FLAT), _areas(z, area / 2, share < -FLAT)
    heights: list[float] = []
    largest = max(up.values(), default=0.0)
    for bin_, size in sorted(up.items(), key=lambda item: (-item[1], item[0])):
        if size < max(FLOOR_AREA, FLOOR_SHARE * largest):
            break
        if all(abs(bin_ * BIN - height) > STOREY for height in heights):
            heights.append(bin_ * BIN)
    if not heights:
        raise UserError(
            f"the mesh has at most {largest:.1f} m2 of level floor at any height, expected {FLOOR_AREA} m2 or more; "
            "check that its z axis points up and that it is in metres"
        )
    return [_floor(corners, z, height, up, down, sorted(heights)) for height in sorted(heights)]


def _areas(
    z: Float32[np.ndarray, " m"], area: np.ndarray, chosen: Bool[np.ndarray, " m"]
) -> dict[int, float]:
    """Area of the chosen faces around each height: of its bin and half of its neighbours'."""
    bins = np.round(z[chosen] / BIN).astype(int)
    found, inverse = np.unique(bins, return_inverse=True)
    sizes = dict(zip(found.tolist(), np.bincount(inverse, weights=area[chosen]).tolist(), strict=True))
    return {
        bin_: size + (sizes.get(bin_ - 1, 0) + sizes.get(bin_ + 1, 0)) / 2 for bin_, size in sizes.items()
    }


def _floor(
    corners: Float32[np.ndarray, "m 3 3"],
    z: Float32[np.ndarray, " m"],
    height: float,
    up: dict[int, float],
    down: dict[int, float],
    heights: Sequence[float],
) -> Floor:
    """A floor with its exact height (the median of its faces') and its ceiling."""
    above = min((other for other in heights if other > height), default=height + 4.5)
    ceilings = {b: size for b, size in down.items() if height + 1.8 < b * BIN < above}
    ceiling = max(ceilings, key=lambda b: ceilings[b]) * BIN if ceilings else min(height + CEILING, above)
    near = corners[np.abs(z - height) < BIN]
    level = float(np.median(near[..., 2])) if len(near) else height
    return Floor(level, float(ceiling))


def cut(building: Building, floor: Floor) -> tuple[Building, tuple[ScannedObject, ...]]:
    """The part of a building that belongs to a floor, and the objects in it that have faces."""
    z = building.vertices[:, 2][building.faces]
    inside = (z.max(axis=1) > floor.height - BELOW) & (z.min(axis=1) < floor.ceiling + BELOW)
    face_object = building.face_object[inside]
    faces = building.faces[inside]
    here = []
    for obj, middle in _middles(building, face_object, faces):
        if floor.height - BELOW <= middle <= floor.ceiling + BELOW:
            here.append(obj)
    kept = np.isin(face_object, [obj.id for obj in here])
    used, compact = np.unique(faces, return_inverse=True)
    part = Building(
        building.vertices[used],
        compact.reshape(-1, 3).astype(np.int32),
        np.where(kept, face_object, 0).astype(np.int32),
        building.face_material[inside],
        building.face_uv[inside],
        building.materials,
        tuple(here),
    )
    return part, tuple(here)


def _middles(
    building: Building, face_object: Int32[np.ndarray, " m"], faces: Int32[np.ndarray, "m 3"]
) -> list[tuple[ScannedObject, float]]:
    """Objects that have faces, each with the height of its faces' middle."""
    order = np.argsort(face_object, kind="stable")
    ids, starts = np.unique(face_object[order], return_index=True)
    z = building.vertices[:, 2][faces[order]].mean(axis=1)
    mean = dict(zip(ids.tolist(), (part.mean() for part in np.split(z, starts[1:])), strict=True))
    return [(obj, float(mean[obj.id])) for obj in building.objects if obj.id in mean]


def mesh_of(building: Building) -> Mesh:
    """The building as the renderer takes it; instance ids are rows of `objects`, from 1."""
    instance = {obj.id: number for number, obj in enumerate(building.objects, start=1)}
    ids, rows = np.unique(building.face_object, return_inverse=True)
    return Mesh(
        building.vertices,
        building.faces,
        np.array([instance.get(id, 0) for id in ids.tolist()], np.int32)[rows],
        building.face_material,
        building.face_uv,
        building.materials,
    )


def upright_box(points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "8 3"] | None) -> OrientedBox:
    """The smallest upright box around an object's points, and its annotated box's corners if it has one."""
    every = np.asarray(points, np.float64) if corners is None else np.concatenate([points, corners])
    # the annotation knows how the object stands, points of a half-seen one do not
    (_, _), _, angle = cv2.minAreaRect((every if corners is None else corners)[:, :2].astype(np.float32))
    yaw = float(np.radians(angle))
    along = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    local = every[:, :2] @ along
    low, high = local.min(axis=0), local.max(axis=0)
    x, y = ((low + high) / 2) @ along.T
    bottom, top = every[:, 2].min(), every[:, 2].max()
    width, depth = np.maximum(high - low, 1e-3).tolist()
    return OrientedBox(
        (float(x), float(y), float((bottom + top) / 2)), (width, depth, float(max(top - bottom, 1e-3))), yaw
    )
