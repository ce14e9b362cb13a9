"""Writers of tiny scanned buildings in the layout of each data set."""

import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imagination.scenes.scene import Scene
from tests.helpers.rooms import tiny_room

COLOURS = np.array([[200, 200, 190], [150, 100, 50], [50, 75, 180], [180, 50, 75], [230, 230, 100]], np.uint8)
"""Colours of the building and its four objects."""

SEGMENT = 1_000_003
"""First segment id of Matterport3D."""


def tiny_building(floors: int = 1) -> list[Scene]:
    """Return one tiny room per floor, 3 m apart, rotated and away from the origin."""
    return [tiny_room(turn=0.4, shift=(2.0, -1.0), floor_height=0.6 + 3.0 * floor) for floor in range(floors)]


def soup(rooms: Sequence[Scene]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices (separate for each quadrilateral), quadrilaterals, their objects (or -1) and colours of rooms."""
    vertices, quads, owners = [], [], []
    start = 0
    for floor, room in enumerate(rooms):
        pairs = room.mesh.faces.reshape(-1, 2, 3)
        quads.append(np.column_stack([pairs[:, 0], pairs[:, 1, 2]]) + start)
        instance = room.mesh.face_instance[::2]
        owners.append(np.where(instance > 0, instance - 1 + 4 * floor, -1))
        vertices.append(room.mesh.vertices)
        start += len(room.mesh.vertices)
    owner = np.concatenate(owners)
    colour = COLOURS[np.where(owner >= 0, owner % 4 + 1, 0)]
    return np.concatenate(vertices), np.concatenate(quads), owner, colour


def ply(
    path: Path, vertices: np.ndarray, polygons: np.ndarray, rgb: np.ndarray, extra: dict[str, np.ndarray]
) -> None:
    """Write a binary PLY file with coloured vertices and extra integer columns of the faces."""
    from plyfile import PlyData, PlyElement

    vertex = np.zeros(
        len(vertices), [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    )
    for place, name in enumerate("xyz"):
        vertex[name] = vertices[:, place]
    for place, name in enumerate(("red", "green", "blue")):
        vertex[name] = rgb[:, place]
    count = polygons.shape[1]
    face = np.zeros(len(polygons), [("vertex_indices", "i4", (count,))] + [(name, "i4") for name in extra])
    face["vertex_indices"] = polygons
    for name, values in extra.items():
        face[name] = values
    path.parent.mkdir(parents=True, exist_ok=True)
    elements = [PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]
    PlyData(elements, byte_order="<").write(path)


def split_quads(quads: np.ndarray) -> np.ndarray:
    """Return two triangles for each quadrilateral."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def write_matterport(folder: Path, name: str = "17DRP5sb8fy", floors: int = 1, habitat: bool = False) -> Path:
    """Write a building as in the release or for Habitat, and return its .house file.

    In the release only the segment column refers to the object, by a record E whose position is not its id.
    """
    rooms = tiny_building(floors)
    vertices, quads, owner, colour = soup(rooms)
    target = folder / name if habitat else folder / name / "house_segmentations"
    faces, face_owner = split_quads(quads), np.repeat(owner, 2)
    rgb = np.repeat(colour, 4, axis=0)
    extra = {"objectid": face_owner} if habitat else {
        "material_id": np.where(face_owner >= 0, SEGMENT + 7 * face_owner, -1),
        "segment_id": np.where(face_owner >= 0, face_owner ^ 1, -1),
        "category_id": np.maximum(face_owner, 0),
    }  # fmt: skip
    ply(target / (f"{name}_semantic.ply" if habitat else f"{name}.ply"), vertices, faces, rgb, extra)
    objects = [obj for room in rooms for obj in room.objects]
    labels = sorted({obj.label for obj in objects})
    lines = ["ASCII 1.1"]
    counts = f"0 0 0 0 {len(objects)} {len(objects)} {len(labels)} {floors} 0 {floors}"
    lines.append(f"H {name} house {counts} 0 0 0 0 0 0 0 0 9 9 9 0 0 0 0 0")
    for floor in range(floors):
        lines.append(f"L {floor} 1 level 0 0 {3 * floor} 0 0 0 9 9 9 0 0 0 0 0")
        lines.append(f"R {floor} {floor} 0 0 b 0 0 0 0 0 0 9 9 9 3 0 0 0 0")
    for number, label in enumerate(labels):
        lines.append(f"C {number} {number} raw#{label} {number} {label} 0 0 0 0 0")
    for number, obj in enumerate(objects):
        x, y, z = obj.box.centre
        cos, sin = np.cos(obj.box.yaw), np.sin(obj.box.yaw)
        radii = " ".join(str(side / 2) for side in obj.box.size)
        axes = f"{cos} {sin} 0 {-sin} {cos} 0"
        lines.append(
            f"O {number} {number // 4} {labels.index(obj.label)} {x} {y} {z} {axes} {radii} 0 0 0 0 0 0 0 0"
        )
    for number in reversed(range(len(objects))):
        lines.append(
            f"E {len(objects) - 1 - number} {number} {SEGMENT + 7 * number} 1 0 0 0 0 0 0 9 9 9 0 0 0 0 0"
        )
    house = target / f"{name}.house"
    house.write_text("\n".join(lines) + "\n")
    return house


def write_replica(folder: Path, name: str = "room_0") -> Path:
    """Write a scene of Replica for Habitat, and return its info_semantic.json."""
    rooms = tiny_building()
    vertices, quads, owner, colour = soup(rooms)
    target = folder / name / "habitat"
    ply(target / "mesh_semantic.ply", vertices, quads, np.repeat(colour, 4, axis=0), {"object_id": owner})
    objects = []
    for number, obj in enumerate(rooms[0].objects):
        rotation = [0.0, 0.0, float(np.sin(obj.box.yaw / 2)), float(np.cos(obj.box.yaw / 2))]
        box = {
            "abb": {"center": [0.0, 0.0, 0.0], "sizes": list(obj.box.size)},
            "orientation": {"rotation": rotation, "translation": list(obj.box.centre)},
        }
        objects.append({"id": number, "class_id": 1, "class_name": obj.label, "oriented_bbox": box})
    path = target / "info_semantic.json"
    path.write_text(json.dumps({"id_to_label": [], "objects": objects}))
    return path


def write_hm3d(folder: Path, name: str = "abcdefghijk", split: str = "train") -> Path:
    """Write a scene with the semantic annotations of HM3D, and return its .semantic.txt."""
    import trimesh
    from PIL import Image

    rooms = tiny_building()
    vertices, quads, owner, colour = soup(rooms)
    target = folder / split / f"00001-{name}"
    target.mkdir(parents=True, exist_ok=True)
    codes = np.array([0x000000, 0xC7D5C5, 0x1A2B3C, 0x4D5E6F, 0x102030])
    semantic_colours = np.stack([codes >> 16 & 255, codes >> 8 & 255, codes & 255], axis=-1).astype(np.uint8)
    for file, colours in ((f"{name}.semantic.glb", semantic_colours), (f"{name}.glb", COLOURS)):
        image = np.repeat(np.repeat(colours[None], 8, axis=0), 8, axis=1)  # five stripes in the lower half
        image = np.concatenate([image[:, ::-1], image])
        u = (owner + 1.5) / len(colours)
        uv = np.repeat(np.stack([u, np.full(len(u), 0.25)], axis=-1), 4, axis=0)
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(image))
        visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        mesh = trimesh.Trimesh(vertices, split_quads(quads), visual=visual, process=False)
        data = io.BytesIO(trimesh.Scene([mesh]).export(file_type="glb"))
        (target / file).write_bytes(data.getvalue())
    lines = ["HM3D Semantic Annotations"]
    for number, obj in enumerate(rooms[0].objects, start=1):
        lines.append(f'{number},{codes[number]:06X},"{obj.label}",0')
    path = target / f"{name}.semantic.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def write_scannet(folder: Path, name: str = "scene0000_00") -> Path:
    """Write a scan of ScanNet v2 and the list of training scans, and return the folder of the scan."""
    rooms = tiny_building()
    vertices, quads, owner, colour = soup(rooms)
    target = folder / "scans" / name
    ply(target / f"{name}_vh_clean_2.ply", vertices, split_quads(quads), np.repeat(colour, 4, axis=0), {})
    segments = np.repeat(owner + 1, 4).tolist()
    (target / f"{name}_vh_clean_2.0.010000.segs.json").write_text(json.dumps({"segIndices": segments}))
    groups = [
        {"id": number, "objectId": number, "label": obj.label, "segments": [number + 1]}
        for number, obj in enumerate(rooms[0].objects)
    ]
    (target / f"{name}.aggregation.json").write_text(json.dumps({"sceneId": name, "segGroups": groups}))
    (target / f"{name}.txt").write_text("axisAlignment = " + " ".join(map(str, np.eye(4).ravel())) + "\n")
    (folder / "scannetv2_train.txt").write_text(f"{name}\n")
    return target
