"""Wavefront OBJ meshes with their materials and pictures, out of an archive.

Our own reader: trimesh 5.2 drops the texture coordinates of files that mix triangles and quadrilaterals (a third of the
catalogues' chairs and tables) and hides what is malformed.
"""

import io
import posixpath
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from imagination.utils.errors import UserError
from imagination_sweethome3d.archives import Archive

MAX_ELEMENTS = 500_000
"""Most vertices, texture coordinates, and triangles that a model may have."""
MAX_LOOKS = 256
"""Most materials, and so pictures, of a model."""
MAX_LIBRARIES = 16
MAX_NOTES = 20
TEXTURE_SIDE = 256
"""Longest side of textures, pixels: a robot's camera sees no more of a chair."""
MAX_PIXELS = 64 * 2**20
FORMATS = ("PNG", "JPEG", "GIF", "BMP")
"""Of pictures, whatever their names say: some of Pillow's other readers start programs."""

Row = list[tuple[int, int]]


@dataclass
class Look:
    """How a material looks: RGB 0 to 1, opacity 0 to 1, a picture."""

    colour: tuple[float, float, float] = (0.7, 0.7, 0.7)
    opacity: float = 1.0
    texture: UInt8[np.ndarray, "th tw 3"] | None = None


@dataclass
class ObjMesh:
    """Triangles as the file has them; `notes` tell what it lacked."""

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    uv: Float[np.ndarray, "m 3 2"]
    face_look: Int[np.ndarray, " m"]
    looks: list[Look]
    notes: list[str] = field(default_factory=list)


def read_obj(archive: Archive, name: str) -> ObjMesh:
    """Read a model.

    Raises:
        UserError: if it is missing or malformed, with the line.
    """
    reader = _Reader(archive, name)
    for number, line in enumerate(archive.lines(name), start=1):
        try:
            reader.take(line.split())
        except (ValueError, IndexError) as error:
            raise UserError(
                f"{archive.path}: {name}, line {number}: got {line.rstrip()[:60]!r}, expected OBJ ({error})"
            ) from error
        if max(len(reader.vertices), len(reader.coordinates), len(reader.corners)) > MAX_ELEMENTS:
            raise UserError(
                f"{archive.path}: {name}: has more than {MAX_ELEMENTS} vertices, texture coordinates or triangles"
            )
    return reader.finished()


class _Reader:
    """Collects the lines of one OBJ file."""

    def __init__(self, archive: Archive, name: str) -> None:
        self.archive, self.folder, self.name = archive, posixpath.dirname(name), name
        self.vertices: list[tuple[float, float, float]] = []
        self.coordinates: list[tuple[float, float]] = []
        self.corners: list[Row] = []
        self.face_look: list[int] = []
        self.looks: list[Look] = [Look()]
        self.rows: dict[str, int] = {}
        self.row = 0
        self.libraries: set[str] = set()
        self.pictures: dict[str, UInt8[np.ndarray, "th tw 3"]] = {}
        self.notes: dict[str, None] = {}
        self.lines = 0  # faces of two corners or fewer

    def take(self, words: list[str]) -> None:
        match words:
            case ["v", x, y, z, *_]:
                self.vertices.append((float(x), float(y), float(z)))
            case ["vt", u, *rest]:
                self.coordinates.append((float(u), float(rest[0]) if rest else 0.0))
            case ["f", *corners]:
                self._face([self._corner(corner) for corner in corners])
            case ["usemtl", *name]:
                self.row = self.rows.get(" ".join(name), 0)
            case ["mtllib", *name]:
                self._library(" ".join(name))
            case ["v", *_]:
                raise ValueError("a vertex has three coordinates")

    def _corner(self, text: str) -> tuple[int, int]:
        """Numbers of a corner's vertex and texture coordinate, from 0; -1 for no coordinate."""
        parts = text.split("/")
        vertex, coordinate = int(parts[0]), int(parts[1]) if len(parts) > 1 and parts[1] else 0
        vertex += len(self.vertices) if vertex < 0 else -1
        coordinate += len(self.coordinates) if coordinate < 0 else -1
        if not 0 <= vertex < len(self.vertices):
            raise ValueError(f"there is no vertex {parts[0]}")
        return vertex, coordinate if 0 <= coordinate < len(self.coordinates) else -1

    def _face(self, corners: Row) -> None:
        if len(corners) < 3:
            self.lines += 1
            return
        for second, third in zip(corners[1:-1], corners[2:], strict=True):
            self.corners.append([corners[0], second, third])
            self.face_look.append(self.row)

    def _library(self, name: str) -> None:
        """Materials of an MTL file; what is missing is noted."""
        path = posixpath.normpath(posixpath.join(self.folder, name.replace("\\", "/")))
        if path not in self.archive:
            self._note(f"its material file {name} is missing")
            return
        if path in self.libraries:
            return
        self.libraries.add(path)
        if len(self.libraries) > MAX_LIBRARIES:
            raise ValueError(f"it names more than {MAX_LIBRARIES} material files")
        look = self.looks[0]
        for line in self.archive.lines(path):
            match line.split():
                case ["newmtl", *words]:
                    look = Look()
                    self.rows[" ".join(words)] = len(self.looks)
                    self.looks.append(look)
                    if len(self.looks) > MAX_LOOKS:
                        raise ValueError(f"it has more than {MAX_LOOKS} materials")
                case ["Kd", red, green, blue, *_]:
                    look.colour = _share(red), _share(green), _share(blue)
                case ["d", value]:
                    look.opacity = _share(value)
                case ["Tr", value]:
                    look.opacity = 1 - _share(value)
                case ["map_Kd", *words]:
                    look.texture = self._picture(" ".join(words))

    def _picture(self, name: str) -> UInt8[np.ndarray, "th tw 3"] | None:
        path = posixpath.normpath(posixpath.join(self.folder, name.replace("\\", "/")))
        if path not in self.archive:
            self._note(f"its picture {name} is missing")
            return None
        if path not in self.pictures:
            if len(self.pictures) == MAX_LOOKS:
                raise ValueError(f"it has more than {MAX_LOOKS} pictures")
            self.pictures[path] = picture(self.archive, path)
        return self.pictures[path]

    def _note(self, text: str) -> None:
        if len(self.notes) < MAX_NOTES:
            self.notes[text] = None

    def finished(self) -> ObjMesh:
        corners = np.array(self.corners, np.int64).reshape(-1, 3, 2)
        places = np.array([*self.coordinates, (0.0, 0.0)])  # the last one is for corners without
        uv, face_look = places[corners[..., 1]], np.array(self.face_look, np.int64)
        bare = (corners[..., 1] < 0).any(axis=1) & np.array(
            [look.texture is not None for look in self.looks]
        )[face_look]
        if bare.any():
            self._note(f"{bare.sum()} faces have a picture but no texture coordinates")
        if self.lines:
            self._note(f"{self.lines} of its faces have fewer than three corners")
        return ObjMesh(
            np.array(self.vertices).reshape(-1, 3),
            corners[..., 0],
            uv,
            face_look,
            self.looks,
            list(self.notes),
        )


def picture(archive: Archive, name: str) -> UInt8[np.ndarray, "th tw 3"]:
    """A picture, at most TEXTURE_SIDE pixels a side.

    Raises:
        UserError: if it is damaged or too large.
    """
    try:
        with Image.open(io.BytesIO(archive.read(name)), formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise UserError(
                    f"{archive.path}: {name} has {image.width} x {image.height} pixels, expected at most {MAX_PIXELS}"
                )
            image.draft("RGB", (TEXTURE_SIDE, TEXTURE_SIDE))
            small = image.convert("RGB")
            small.thumbnail((TEXTURE_SIDE, TEXTURE_SIDE))
            return np.asarray(small)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{archive.path}: {name} is no picture that can be read ({error})") from error


def _share(text: str) -> float:
    return min(max(float(text), 0.0), 1.0)
