"""The ray-cast renderer: embree finds what each pixel sees, two numba kernels make the rays and the image.

One renderer uses one core; run a process a core. The same scene and camera always give the same image.
"""

from typing import NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float32, Int32, UInt8

from imagination.geometry.camera import Camera
from imagination.scenes.scene import Lighting, Material, Mesh, Scene
from imagination.utils.errors import UserError
from imagination.utils.jit import compiled


class Image(NamedTuple):
    """What a camera sees.

    Attributes:
        rgb: black where nothing returned.
        depth: metres along the optical axis, 0 where nothing returned.
        instance: the object's id, 0 for the building, -1 where nothing returned.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    instance: Int32[np.ndarray, "h w"]


@runtime_checkable
class SceneRenderer(Protocol):
    """Renders one scene."""

    def render(self, camera: Camera, camera_to_world: Float[np.ndarray, "4 4"], colour: bool = True) -> Image:
        """What `camera` sees from a pose with six degrees of freedom, as `Renderer.render` gives it."""


class _Atlas(NamedTuple):
    """All textures in a row; `start`, `height` and `width` tell where each material's lies (height 0: none)."""

    texels: UInt8[np.ndarray, "t 3"]
    start: Int32[np.ndarray, " k"]
    height: Int32[np.ndarray, " k"]
    width: Int32[np.ndarray, " k"]


class _Faces(NamedTuple):
    """What shading needs to know of each face; `shade` is its colour from the front and from the back, 0 to 255."""

    instance: Int32[np.ndarray, " m"]
    material: Int32[np.ndarray, " m"]
    uv: Float32[np.ndarray, "m 3 2"]
    shade: Float32[np.ndarray, "m 2 3"]


class _Hits(NamedTuple):
    """What each ray hit: the face (-1: none), the weights of its second and third corner, the depth, and the normal on
    the side from which the corners run counter-clockwise."""

    face: Int32[np.ndarray, " n"]
    second: Float32[np.ndarray, " n"]
    third: Float32[np.ndarray, " n"]
    depth: Float32[np.ndarray, " n"]
    normal: Float32[np.ndarray, "n 3"]


class Renderer:
    """Renders one mesh from any pinhole camera in any pose.

    Surfaces are matt and look the same from both sides: a face's colour is the material's times the sum of the ambient
    light and, for each light, its colour times the cosine between the direction to the light and the side's normal.

    Args:
        mesh: of the whole scene, copied into the ray caster.
        lighting: of the scene.

    Raises:
        UserError: if the mesh is empty, or not finite, or refers to vertices or materials that do not exist.
    """

    def __init__(self, mesh: Mesh, lighting: Lighting) -> None:
        _check(mesh)
        self._scene = EmbreeScene()
        self._triangles = TriangleMesh(self._scene, mesh.vertices, mesh.faces)  # kept alive with the scene
        self._faces = _Faces(mesh.face_instance, mesh.face_material, mesh.face_uv, _shades(mesh, lighting))
        self._atlas = _pack(mesh.materials)

    def render(self, camera: Camera, camera_to_world: Float[np.ndarray, "4 4"], colour: bool = True) -> Image:
        """What `camera` sees from a pose with six degrees of freedom.

        Args:
            camera: its size and field of view; its mounting is already part of the pose.
            camera_to_world: rigid transform from the optical frame (x right, y down, z forward) to the world's.
            colour: whether `rgb` will be looked at; a renderer may leave it black otherwise.

        Raises:
            UserError: if the pose is not a finite rigid transform.
        """
        _check_pose(camera_to_world)
        origins, directions = _rays(
            camera.width, camera.height, camera.focal_length, *camera.principal_point, camera_to_world
        )
        hits = self._scene.run(origins, directions, query="INTERSECT", output=True)
        image = Image(
            np.zeros((camera.height, camera.width, 3), np.uint8),
            np.zeros((camera.height, camera.width), np.float32),
            np.full((camera.height, camera.width), -1, np.int32),
        )
        _shade(
            _Hits(hits["primID"], hits["u"], hits["v"], hits["tfar"], hits["Ng"]),
            directions,
            self._faces,
            self._atlas,
            colour,
            image.rgb.reshape(-1, 3),
            image.depth.reshape(-1),
            image.instance.reshape(-1),
        )
        return image


def renderer_of(scene: Scene) -> SceneRenderer:
    """The scene's own renderer if it brings one, else the ray caster of its mesh."""
    if scene.renderer is not None:
        return cast(SceneRenderer, scene.renderer)
    return Renderer(scene.mesh, scene.lighting)


def _check(mesh: Mesh) -> None:
    count = len(mesh.faces)
    if count == 0:
        raise UserError("renderer: got a mesh without faces, expected at least one; check the scene's files")
    for name in ("face_instance", "face_material", "face_uv"):
        if len(getattr(mesh, name)) != count:
            raise UserError(
                f"renderer: got {len(getattr(mesh, name))} rows of mesh.{name}, expected {count}, one a face"
            )
    for name in ("vertices", "face_uv"):
        if not np.isfinite(getattr(mesh, name)).all():
            raise UserError(f"renderer: got NaN or infinity in mesh.{name}, expected finite numbers")
    _check_indices("faces", mesh.faces, len(mesh.vertices), "vertices")
    _check_indices("face_material", mesh.face_material, len(mesh.materials), "materials")
    if mesh.face_instance.min() < 0:
        raise UserError(
            f"renderer: got instance id {mesh.face_instance.min()} in mesh.face_instance, expected 0 or more"
        )


def _check_indices(name: str, indices: Int32[np.ndarray, "..."], count: int, of: str) -> None:
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= count:
        raise UserError(
            f"renderer: got indices {low} to {high} in mesh.{name}, expected 0 to {count - 1}, one of {of}"
        )


def _check_pose(camera_to_world: Float[np.ndarray, "4 4"]) -> None:
    rotation = camera_to_world[:3, :3]
    if not np.isfinite(camera_to_world).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise UserError(
            f"renderer: got the camera pose {camera_to_world.tolist()}, expected finite "
            "numbers that rotate and shift"
        )


def _shades(mesh: Mesh, lighting: Lighting) -> Float32[np.ndarray, "m 2 3"]:
    """Colour of each face's front (where its corners run counter-clockwise) and back, 0 to 255, before the texture."""
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    cosine = normal @ lighting.directions.T
    sides = np.stack([np.maximum(cosine, 0.0), np.maximum(-cosine, 0.0)], axis=1)
    light = np.array(lighting.ambient, np.float32) + sides @ lighting.colours
    colours = np.array([material.colour for material in mesh.materials], np.float32)
    return np.asarray(255 * light * colours[mesh.face_material][:, None], np.float32)


def _pack(materials: tuple[Material, ...]) -> _Atlas:
    textures = [m.texture if m.texture is not None else np.zeros((0, 0, 3), np.uint8) for m in materials]
    texels = np.concatenate([texture.reshape(-1, 3) for texture in textures])
    height, width = np.array([texture.shape[:2] for texture in textures], np.int32).T
    start = np.cumsum(height * width, dtype=np.int32) - height * width
    return _Atlas(texels, start.astype(np.int32), height.copy(), width.copy())


@compiled
def _rays(
    width: int,
    height: int,
    focal_length: float,
    centre_x: float,
    centre_y: float,
    camera_to_world: Float[np.ndarray, "4 4"],
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Origins and directions in the world, row by row. Along the optical axis each direction measures 1, so that the
    distance the ray caster returns, in lengths of the direction, is the depth itself."""
    origins = np.empty((height * width, 3), np.float32)
    directions = np.empty((height * width, 3), np.float32)
    origin, rotation = camera_to_world[:3, 3], camera_to_world[:3, :3]
    index = 0
    for row in range(height):
        down = (row + 0.5 - centre_y) / focal_length
        for column in range(width):
            right = (column + 0.5 - centre_x) / focal_length
            for axis in range(3):
                origins[index, axis] = origin[axis]
                directions[index, axis] = (
                    rotation[axis, 0] * right + rotation[axis, 1] * down + rotation[axis, 2]
                )
            index += 1
    return origins, directions


@compiled
def _shade(
    hits: _Hits,
    directions: Float32[np.ndarray, "n 3"],
    faces: _Faces,
    atlas: _Atlas,
    colour: bool,
    rgb: UInt8[np.ndarray, "n 3"],
    depth: Float32[np.ndarray, " n"],
    instance: Int32[np.ndarray, " n"],
) -> None:
    """Fill the image from what the rays hit."""
    half, most = np.float32(0.5), np.float32(255)
    for ray in range(hits.face.shape[0]):
        face = hits.face[ray]
        if face < 0:
            continue
        depth[ray] = hits.depth[ray]
        instance[ray] = faces.instance[face]
        if not colour:
            continue
        along = np.float32(0)
        for axis in range(3):
            along += hits.normal[ray, axis] * directions[ray, axis]
        side = 0 if along < 0 else 1
        material = faces.material[face]
        if atlas.height[material] == 0:
            for channel in range(3):
                rgb[ray, channel] = min(faces.shade[face, side, channel] + half, most)
            continue
        second, third = hits.second[ray], hits.third[ray]
        first = np.float32(1) - second - third
        u = first * faces.uv[face, 0, 0] + second * faces.uv[face, 1, 0] + third * faces.uv[face, 2, 0]
        v = first * faces.uv[face, 0, 1] + second * faces.uv[face, 1, 1] + third * faces.uv[face, 2, 1]
        texel = _texel(atlas, material, u, v)
        for channel in range(3):
            rgb[ray, channel] = min(faces.shade[face, side, channel] * texel[channel] + half, most)


@compiled
def _texel(
    atlas: _Atlas, material: int, u: np.float32, v: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """Bilinear colour, 0 to 1, of a repeating texture; its first row is at the top, where v is 1."""
    start, height, width = atlas.start[material], atlas.height[material], atlas.width[material]
    left, right, to_right = _neighbours(u - np.floor(u), width)
    upper, lower, to_lower = _neighbours(np.ceil(v) - v, height)
    one, scale = np.float32(1), np.float32(1 / 255)
    weights = (
        (one - to_lower) * (one - to_right) * scale,
        (one - to_lower) * to_right * scale,
        to_lower * (one - to_right) * scale,
        to_lower * to_right * scale,
    )
    upper, lower = start + upper * width, start + lower * width
    places = (upper + left, upper + right, lower + left, lower + right)
    return (
        _mix(atlas.texels, places, weights, 0),
        _mix(atlas.texels, places, weights, 1),
        _mix(atlas.texels, places, weights, 2),
    )


@compiled
def _neighbours(share: np.float32, count: int) -> tuple[int, int, np.float32]:
    """The two texels whose centres lie around `share` (0 to 1) of the way through `count`; how near the second is."""
    place = share * np.float32(count) - np.float32(0.5)
    first = int(np.floor(place))
    second = first + 1
    nearness = place - np.float32(first)
    return (first if first >= 0 else count - 1), (second if second < count else 0), nearness


@compiled
def _mix(
    texels: UInt8[np.ndarray, "t 3"],
    places: tuple[int, int, int, int],
    weights: tuple[np.float32, np.float32, np.float32, np.float32],
    channel: int,
) -> np.float32:
    """Weighted sum of one channel of four texels."""
    return (
        weights[0] * np.float32(texels[places[0], channel])
        + weights[1] * np.float32(texels[places[1], channel])
        + weights[2] * np.float32(texels[places[2], channel])
        + weights[3] * np.float32(texels[places[3], channel])
    )
