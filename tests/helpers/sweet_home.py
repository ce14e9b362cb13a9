"""Writers of tiny furniture archives and homes of Sweet Home 3D."""

import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

Box = tuple[float, float, float, float, float, float]
"""x0, y0, z0, x1, y1, z1 in the frame of the catalogue: x to the right, y up, z to the front; centimetres."""

CHAIR: tuple[Box, ...] = (
    (0, 40, 0, 45, 45, 45),
    (0, 45, 0, 45, 90, 5),  # the back: its front is at +z
    (0, 0, 0, 4, 40, 4),
    (41, 0, 0, 45, 40, 4),
    (0, 0, 41, 4, 40, 45),
    (41, 0, 41, 45, 40, 45),
)
TABLE: tuple[Box, ...] = (
    (0, 70, 0, 140, 75, 80),
    (0, 0, 0, 6, 70, 6),
    (134, 0, 0, 140, 70, 6),
    (0, 0, 74, 6, 70, 80),
    (134, 0, 74, 140, 70, 80),
)
BED: tuple[Box, ...] = ((0, 0, 0, 150, 45, 200), (0, 45, 0, 150, 95, 6))


def obj(boxes: Iterable[Box], material: str = "plain") -> str:
    """Return boxes as OBJ with quadrilaterals and triangles and repeating texture coordinates."""
    lines = ["mtllib model.mtl", f"usemtl {material}", "vt 0 0", "vt 2 0", "vt 2 2", "vt 0 2"]
    for number, (x0, y0, z0, x1, y1, z1) in enumerate(boxes):
        corners = [(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]
        lines += [f"v {x} {y} {z}" for x, y, z in corners]
        for side in ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5)):
            lines.append("f " + " ".join(f"{8 * number + v}/{t}" for t, v in enumerate(side, start=1)))
        a, b, c, d = (8 * number + v for v in (2, 6, 8, 4))
        lines += [f"f {a}/1 {b}/2 {c}/3", f"f {a}/1 {c}/3 {d}/4"]
    return "\n".join(lines) + "\n"


MATERIALS = "newmtl plain\nKd 0.6 0.4 0.2\nnewmtl glass\nKd 0.5 0.7 0.9\nd 0.3\nnewmtl air\nd 0\n"


def entry(number: int, id: str, name: str, boxes: Iterable[Box], **changes: str) -> dict[str, str]:
    """Return the properties of a catalogue entry with the size of the boxes."""
    corners = np.array(list(boxes))
    size = corners[:, 3:].max(axis=0) - corners[:, :3].min(axis=0)
    values = {
        "id": id,
        "name": name,
        "category": "Living room",
        "model": f"/models/{id.partition('#')[2]}/model.obj",
        "width": str(size[0]),
        "depth": str(size[2]),
        "height": str(size[1]),
        "doorOrWindow": "false",
        "creator": "Somebody",
    }
    return {f"{key}#{number}": value for key, value in (values | changes).items()}


def scaled(boxes: Iterable[Box], factor: float) -> tuple[Box, ...]:
    """Scale boxes by a factor."""
    return tuple(tuple((np.array(box) * factor).tolist()) for box in boxes)  # type: ignore[misc]


def write_archive(path: Path, members: Mapping[str, str | bytes]) -> Path:
    """Write a zip file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


def write_catalogue(path: Path) -> Path:
    """Write an archive of four chairs, tables and beds each, of different sizes."""
    properties: dict[str, str] = {}
    members: dict[str, str | bytes] = {"LICENSE.TXT": "http://creativecommons.org/licenses/by/3.0/"}
    shapes = {"Chair": CHAIR, "Table": TABLE, "Bed": BED}
    number = 0
    for name, boxes in shapes.items():
        for factor in (0.95, 1.0, 1.06, 1.12):
            number += 1
            id = f"Test#{name.lower()}{number}"
            properties |= entry(number, id, name, scaled(boxes, factor))
            members[f"models/{name.lower()}{number}/model.obj"] = obj(boxes)
            members[f"models/{name.lower()}{number}/model.mtl"] = MATERIALS
    members["PluginFurnitureCatalog.properties"] = "\n".join(
        f"{key}={value}" for key, value in properties.items()
    )
    translated = "\n".join(f"name#{n}={w}" for n, w in ((1, "Trona"), (5, "Taula")))
    members["PluginFurnitureCatalog_ca.properties"] = translated
    return write_archive(path, members)


def piece(id: str, name: str, x: float, y: float, size: tuple[float, float, float], **more: str) -> str:
    """Return a piece of furniture of a home, in centimetres on the plan with y down."""
    width, depth, height = size
    attributes = {
        "catalogId": id,
        "name": name,
        "x": x,
        "y": y,
        "width": width,
        "depth": depth,
        "height": height,
    }
    text = " ".join(f'{key}="{value}"' for key, value in (attributes | more).items())
    return f"<pieceOfFurniture {text}/>"


def walls(x0: float, y0: float, x1: float, y1: float, level: str = "") -> str:
    """Return four walls around a rectangle, and its room."""
    where = f'level="{level}"' if level else ""
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    lines = [
        f'<wall {where} xStart="{a[0]}" yStart="{a[1]}" xEnd="{b[0]}" yEnd="{b[1]}" height="250" thickness="10"/>'
        for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)
    ]
    points = "".join(f'<point x="{x}" y="{y}"/>' for x, y in corners)
    return "".join([*lines, f"<room {where}>{points}</room>"])


def home_xml(inside: str) -> str:
    return f"<?xml version='1.0'?><home version='7000' wallHeight='250'>{inside}</home>"


def furnished(level: str = "") -> str:
    """Return a room of 5 m by 4 m with a door, a window, a chair, a table and a bed."""
    where = {"level": level} if level else {}
    door = f'<doorOrWindow {"".join(f"{k}={v!r} " for k, v in where.items())}name="Door" x="250" y="0" width="90" '
    window = door.replace('x="250" y="0"', 'x="0" y="200" angle="1.5707964" elevation="90"')
    return (
        walls(0, 0, 500, 400, level)
        + door + 'depth="10" height="210"/>'
        + window + 'depth="10" height="100"/>'
        + piece("Test#chair1", "Sedia", 100, 250, (45, 45, 90), model="0/model.obj", angle="0.5", **where)
        + piece("", "Tisch", 200, 320, (140, 80, 75), **where)
        + piece("eTeks#bed140x190", "?", 400, 110, (150, 200, 95), model="1/model.obj", **where)
    )  # fmt: skip


def write_home(path: Path, inside: str | None = None, extra: Mapping[str, str] | None = None) -> Path:
    """Write a home with the models of its chair and bed, and extra members."""
    content = furnished() if inside is None else inside
    members: dict[str, str | bytes] = {
        "Home.xml": home_xml(content),
        "0/model.obj": obj(CHAIR),
        "0/model.mtl": MATERIALS,
        "1/model.obj": obj(BED, "glass"),
        "1/model.mtl": MATERIALS,
        **(extra or {}),
    }
    return write_archive(path, members)
