"""Reader of Wavefront OBJ meshes with their materials and textures in an archive.

trimesh 5.2 drops the texture coordinates of files that mix triangles and quadrilaterals (a third of the catalogues'
chairs and tables) and hides malformed lines.
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
"""Maximum number of vertices, of texture coordinates, and of triangles of a model."""
MAX_MATERIALS = 256
"""Maximum number of materials, and of textures, of a model."""
MAX_LIBRARIES = 16
"""Maximum number of material files of a model."""
MAX_NOTES = 20
TEXTURE_SIDE = 256
"""Maximum side of a texture, pixels; the robot's camera resolves no more of a chair."""
MAX_PIXELS = 64 * 2**20
"""Maximum number of pixels of an image file."""
FORMATS = ("PNG", "JPEG", "GIF", "BMP")
"""Image formats allowed, whatever the file name: other readers of Pillow may start programs."""

Polygon = list[tuple[int, int]]


@dataclass
class ObjMaterial:
    """Material: RGB and opacity in [0, 1], and a texture."""

    colour: tuple[float, float, float] = (0.7, 0.7, 0.7)
    opacity: float = 1.0
    texture: UInt8[np.ndarray, "th tw 3"] | None = None


@dataclass
class ObjMesh:
    """Triangles of a file; `notes` lists its defects."""

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    uv: Float[np.ndarray, "m 3 2"]
    face_material: Int[np.ndarray, " m"]
    materials: list[ObjMaterial]
    notes: list[str] = field(default_factory=list)


def read_obj(archive: Archive, name: str) -> ObjMesh:
    """Read a mesh.

    Raises:
        UserError: if the file is missing or malformed; the message names the line.
    """
    reader = _Reader(archive, name)
    for number, line in enumerate(archive.lines(name), start=1):
        try:
            reader.parse(line.split())
        except (ValueError, IndexError) as error:
            raise UserError(
                f"{archive.path}: {name}, line {number}: got {line.rstrip()[:60]!r}, expected OBJ ({error})"
            ) from error
        if max(len(reader.vertices), len(reader.coordinates), len(reader.corners)) > MAX_ELEMENTS:
            raise UserError(
                f"{archive.path}: {name}: got more than {MAX_ELEMENTS} vertices, texture coordinates or triangles"
            )
    return reader.mesh()


class _Reader:
    """Parser of one OBJ file, line by line."""

    def __init__(self, archive: Archive, name: str) -> None:
        self.archive, self.folder, self.name = archive, posixpath.dirname(name), name
        self.vertices: list[tuple[float, float, float]] = []
        self.coordinates: list[tuple[float, float]] = []
        self.corners: list[Polygon] = []
        self.face_material: list[int] = []
        self.materials: list[ObjMaterial] = [ObjMaterial()]
        self.rows: dict[str, int] = {}
        self.row = 0
        self.libraries: set[str] = set()
        self.textures: dict[str, UInt8[np.ndarray, "th tw 3"]] = {}
        self.notes: dict[str, None] = {}
        self.degenerate = 0  # faces of fewer than three corners

    def parse(self, words: list[str]) -> None:
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
                raise ValueError("a vertex needs three coordinates")

    def _corner(self, text: str) -> tuple[int, int]:
        """Return the indices of the vertex and texture coordinate of a corner, from 0; -1 for no coordinate."""
        parts = text.split("/")
        vertex, coordinate = int(parts[0]), int(parts[1]) if len(parts) > 1 and parts[1] else 0
        vertex += len(self.vertices) if vertex < 0 else -1
        coordinate += len(self.coordinates) if coordinate < 0 else -1
        if not 0 <= vertex < len(self.vertices):
            raise ValueError(f"vertex {parts[0]} does not exist")
        return vertex, coordinate if 0 <= coordinate < len(self.coordinates) else -1

    def _face(self, corners: Polygon) -> None:
        if len(corners) < 3:
            self.degenerate += 1
            return
        for second, third in zip(corners[1:-1], corners[2:], strict=True):
            self.corners.append([corners[0], second, third])
            self.face_material.append(self.row)

    def _library(self, name: str) -> None:
        """Read the materials of an MTL file; note missing files."""
        path = posixpath.normpath(posixpath.join(self.folder, name.replace("\\", "/")))
        if path not in self.archive:
            self._note(f"the material file {name} is missing")
            return
        if path in self.libraries:
            return
        self.libraries.add(path)
        if len(self.libraries) > MAX_LIBRARIES:
            raise ValueError(f"got more than {MAX_LIBRARIES} material files")
        material = self.materials[0]
        for line in self.archive.lines(path):
            match line.split():
                case ["newmtl", *words]:
                    material = ObjMaterial()
                    self.rows[" ".join(words)] = len(self.materials)
                    self.materials.append(material)
                    if len(self.materials) > MAX_MATERIALS:
                        raise ValueError(f"got more than {MAX_MATERIALS} materials")
                case ["Kd", red, green, blue, *_]:
                    material.colour = _fraction(red), _fraction(green), _fraction(blue)
                case ["d", value]:
                    material.opacity = _fraction(value)
                case ["Tr", value]:
                    material.opacity = 1 - _fraction(value)
                case ["map_Kd", *words]:
                    material.texture = self._texture(" ".join(words))

    def _texture(self, name: str) -> UInt8[np.ndarray, "th tw 3"] | None:
        path = posixpath.normpath(posixpath.join(self.folder, name.replace("\\", "/")))
        if path not in self.archive:
            self._note(f"the texture {name} is missing")
            return None
        if path not in self.textures:
            if len(self.textures) == MAX_MATERIALS:
                raise ValueError(f"got more than {MAX_MATERIALS} textures")
            self.textures[path] = read_texture(self.archive, path)
        return self.textures[path]

    def _note(self, text: str) -> None:
        if len(self.notes) < MAX_NOTES:
            self.notes[text] = None

    def mesh(self) -> ObjMesh:
        corners = np.array(self.corners, np.int64).reshape(-1, 3, 2)
        coordinates = np.array([*self.coordinates, (0.0, 0.0)])  # the last row is for corners without
        uv, face_material = coordinates[corners[..., 1]], np.array(self.face_material, np.int64)
        textured = np.array([material.texture is not None for material in self.materials])[face_material]
        unmapped = textured & (corners[..., 1] < 0).any(axis=1)
        if unmapped.any():
            self._note(f"{unmapped.sum()} faces have a texture but no texture coordinates")
        if self.degenerate:
            self._note(f"{self.degenerate} faces have fewer than three corners")
        return ObjMesh(
            np.array(self.vertices).reshape(-1, 3),
            corners[..., 0],
            uv,
            face_material,
            self.materials,
            list(self.notes),
        )


def read_texture(archive: Archive, name: str) -> UInt8[np.ndarray, "th tw 3"]:
    """Read an image, scaled down to at most TEXTURE_SIDE pixels a side.

    Raises:
        UserError: if the image is damaged or has more than MAX_PIXELS.
    """
    try:
        with Image.open(io.BytesIO(archive.read(name)), formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise UserError(
                    f"{archive.path}: {name}: got {image.width} x {image.height} pixels, expected at most {MAX_PIXELS}"
                )
            image.draft("RGB", (TEXTURE_SIDE, TEXTURE_SIDE))
            small = image.convert("RGB")
            small.thumbnail((TEXTURE_SIDE, TEXTURE_SIDE))
            return np.asarray(small)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(
            f"{archive.path}: {name}: cannot be read as {', '.join(FORMATS)} ({error})"
        ) from error


def _fraction(text: str) -> float:
    return min(max(float(text), 0.0), 1.0)
