"""Scanned buildings and their floors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from imagination.scenes.scene import Material, Mesh, OrientedBox
from imagination.utils.errors import UserError

MIN_NORMAL_Z = 0.95
"""Minimum absolute vertical component of the unit normal of floors and ceilings."""
BIN = 0.05
"""Bin width of the histogram of heights, metres."""
STOREY = 1.9
"""Minimum height between two floors, metres."""
MIN_FLOOR_AREA, MIN_FLOOR_FRACTION = 3.0, 0.2
"""Minimum area of a floor, m2, and minimum fraction of the area of the largest floor."""
CEILING = 2.6
"""Height of the ceiling above the floor where the scan has none, metres."""
MARGIN = 0.3
"""Distance below a floor or above its ceiling up to which objects belong to it, metres."""
GREY = 180
"""Level of each colour channel where the scan has no colour."""
MAX_ID = 2**31 - 1
"""Upper bound of object ids, exclusive."""


@dataclass(frozen=True)
class ScannedObject:
    """Annotated object: id in the mesh (from 1), name, and corners of its box or None."""

    id: int
    name: str
    corners: Float[np.ndarray, "8 3"] | None = None


@dataclass(frozen=True)
class Building:
    """Triangles with z up, metres; `face_object` is the id of the object of each face, 0 for no object."""

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
    """Check that a building has a mesh and objects with faces.

    Raises:
        UserError: if the mesh is empty, there are no objects, or the object ids are invalid.
    """
    if len(building.faces) == 0:
        raise UserError(f"{where}: the mesh has no faces")
    if not building.objects:
        raise UserError(f"{where}: got no objects, expected named objects; its semantics are empty")
    face_ids = set(np.unique(building.face_object).tolist())
    ids = [obj.id for obj in building.objects]
    if min(ids) < 1 or len(set(ids)) < len(ids):
        raise UserError(f"{where}: object ids: got {sorted(ids)[:5]} …, expected unique ids from 1")
    if not face_ids & set(ids):
        raise UserError(
            f"{where}: none of {len(building.objects)} objects has a face in the mesh (ids in the mesh: "
            f"{sorted(face_ids)[:5]} …); the mesh and the annotation do not match"
        )


def colour_texture(
    rgb: UInt8[np.ndarray, "m 3"],
) -> tuple[tuple[Material, ...], Int32[np.ndarray, " m"], Float32[np.ndarray, "m 3 2"]]:
    """Return materials, their rows and texture coordinates that give each face one colour of 32 levels per channel.

    One texture holds all colours, and each face refers to the centre of a texel; this avoids one material per colour.
    """
    levels = np.arange(32) * 255 // 31
    red, green, blue = np.meshgrid(levels, levels, levels, indexing="ij")
    palette = np.stack([red, green, blue], axis=-1).reshape(128, 256, 3).astype(np.uint8)
    index = ((rgb >> 3).astype(np.int64) * [1024, 32, 1]).sum(axis=1)
    u, v = (index % 256 + 0.5) / 256, 1 - (index // 256 + 0.5) / 128
    uv = np.repeat(np.stack([u, v], axis=-1)[:, None].astype(np.float32), 3, axis=1)
    return (Material((1.0, 1.0, 1.0), palette),), np.zeros(len(rgb), np.int32), uv


def floors_of(building: Building) -> list[Floor]:
    """Return the floors, lowest first: heights with large horizontal upward-facing area, a storey apart.

    Raises:
        UserError: if no height has enough horizontal upward-facing area.
    """
    corners = building.vertices[building.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    normal_z = normal[:, 2] / np.maximum(area, 1e-12)
    z = corners[..., 2].mean(axis=1)
    up = _areas(z, area / 2, normal_z > MIN_NORMAL_Z)
    down = _areas(z, area / 2, normal_z < -MIN_NORMAL_Z)
    heights: list[float] = []
    largest = max(up.values(), default=0.0)
    for bin_, size in sorted(up.items(), key=lambda item: (-item[1], item[0])):
        if size < max(MIN_FLOOR_AREA, MIN_FLOOR_FRACTION * largest):
            break
        if all(abs(bin_ * BIN - height) > STOREY for height in heights):
            heights.append(bin_ * BIN)
    if not heights:
        raise UserError(
            f"horizontal area of the mesh: got at most {largest:.1f} m2 at any height, expected {MIN_FLOOR_AREA} m2 or "
            "more; check that z points up and that the unit is metres"
        )
    return [_floor(corners, z, height, up, down, sorted(heights)) for height in sorted(heights)]


def _areas(
    z: Float32[np.ndarray, " m"], area: np.ndarray, selected: Bool[np.ndarray, " m"]
) -> dict[int, float]:
    """Return the area of the selected faces in each bin of heights plus half of that in its neighbours."""
    bins, inverse = np.unique(np.round(z[selected] / BIN).astype(int), return_inverse=True)
    sizes = dict(zip(bins.tolist(), np.bincount(inverse, weights=area[selected]).tolist(), strict=True))
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
    """Return a floor with its exact height, the median of its faces, and its ceiling."""
    above = min((other for other in heights if other > height), default=height + 4.5)
    ceilings = {b: size for b, size in down.items() if height + 1.8 < b * BIN < above}
    ceiling = max(ceilings, key=lambda b: ceilings[b]) * BIN if ceilings else min(height + CEILING, above)
    near = corners[np.abs(z - height) < BIN]
    level = float(np.median(near[..., 2])) if len(near) else height
    return Floor(level, float(ceiling))


def crop_to_floor(building: Building, floor: Floor) -> tuple[Building, tuple[ScannedObject, ...]]:
    """Return the part of a building that belongs to a floor, and its objects that have faces."""
    z = building.vertices[:, 2][building.faces]
    inside = (z.max(axis=1) > floor.height - MARGIN) & (z.min(axis=1) < floor.ceiling + MARGIN)
    face_object = building.face_object[inside]
    faces = building.faces[inside]
    objects = tuple(
        obj
        for obj, height in _mean_heights(building, face_object, faces)
        if floor.height - MARGIN <= height <= floor.ceiling + MARGIN
    )
    annotated = np.isin(face_object, [obj.id for obj in objects])
    used, compact = np.unique(faces, return_inverse=True)
    part = Building(
        building.vertices[used],
        compact.reshape(-1, 3).astype(np.int32),
        np.where(annotated, face_object, 0).astype(np.int32),
        building.face_material[inside],
        building.face_uv[inside],
        building.materials,
        objects,
    )
    return part, objects


def _mean_heights(
    building: Building, face_object: Int32[np.ndarray, " m"], faces: Int32[np.ndarray, "m 3"]
) -> list[tuple[ScannedObject, float]]:
    """Return the objects that have faces, each with the mean height of its faces, metres."""
    order = np.argsort(face_object, kind="stable")
    ids, starts = np.unique(face_object[order], return_index=True)
    z = building.vertices[:, 2][faces[order]].mean(axis=1)
    mean = dict(zip(ids.tolist(), (part.mean() for part in np.split(z, starts[1:])), strict=True))
    return [(obj, float(mean[obj.id])) for obj in building.objects if obj.id in mean]


def mesh_of(building: Building) -> Mesh:
    """Convert a building to a mesh for the renderer; instance ids are positions in `objects`, from 1."""
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
    """Return the smallest upright box around the points of an object and the corners of its annotated box, if any."""
    cloud = np.asarray(points, np.float64) if corners is None else np.concatenate([points, corners])
    # the annotated box gives a better yaw than the points of a partly scanned object
    (_, _), _, angle = cv2.minAreaRect((cloud if corners is None else corners)[:, :2].astype(np.float32))
    yaw = float(np.radians(angle))
    along = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    local = cloud[:, :2] @ along
    low, high = local.min(axis=0), local.max(axis=0)
    x, y = ((low + high) / 2) @ along.T
    bottom, top = cloud[:, 2].min(), cloud[:, 2].max()
    width, depth = np.maximum(high - low, 1e-3).tolist()
    return OrientedBox(
        (float(x), float(y), float((bottom + top) / 2)), (width, depth, float(max(top - bottom, 1e-3))), yaw
    )
