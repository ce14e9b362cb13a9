"""Ray-casting renderer: Embree intersects the rays, two Numba kernels generate the rays and shade the image.

A renderer uses one core; run one process for each core. Rendering is deterministic.
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
    """Rendered image.

    Attributes:
        rgb: colour, black where there is no return.
        depth: depth along the optical axis, metres; 0 where there is no return.
        instance: instance id of the object, 0 for the building, -1 where there is no return.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    instance: Int32[np.ndarray, "h w"]


@runtime_checkable
class SceneRenderer(Protocol):
    """Renderer of one scene."""

    def render(self, camera: Camera, camera_to_world: Float[np.ndarray, "4 4"], colour: bool = True) -> Image:
        """Render the image of `camera` from a pose with six degrees of freedom, as `Renderer.render`."""


class _Atlas(NamedTuple):
    """Texels of all textures, with start, height and width of the texture of each material (height 0: no texture)."""

    texels: UInt8[np.ndarray, "t 3"]
    start: Int32[np.ndarray, " k"]
    height: Int32[np.ndarray, " k"]
    width: Int32[np.ndarray, " k"]


class _Faces(NamedTuple):
    """Shading data of each face; `shade` is its colour from the front and from the back, 0 to 255."""

    instance: Int32[np.ndarray, " m"]
    material: Int32[np.ndarray, " m"]
    uv: Float32[np.ndarray, "m 3 2"]
    shade: Float32[np.ndarray, "m 2 3"]


class _Hits(NamedTuple):
    """Intersection of each ray: face (-1: no hit), weights of its second and third corner, depth, and normal.

    The normal is on the side from which the corners run counter-clockwise.
    """

    face: Int32[np.ndarray, " n"]
    second: Float32[np.ndarray, " n"]
    third: Float32[np.ndarray, " n"]
    depth: Float32[np.ndarray, " n"]
    normal: Float32[np.ndarray, "n 3"]


class Renderer:
    """Renderer of one mesh for any pinhole camera in any pose.

    Surfaces are Lambertian and two-sided: the colour of a face is that of its material, times the sum of the ambient
    light and, for each light, its colour times the cosine between the direction to the light and the normal.

    Args:
        mesh: mesh of the whole scene; the ray caster copies it.
        lighting: lighting of the scene.

    Raises:
        UserError: if the mesh is empty or not finite, or refers to vertices or materials that do not exist.
    """

    def __init__(self, mesh: Mesh, lighting: Lighting) -> None:
        _check(mesh)
        self._scene = EmbreeScene()
        # must live as long as the scene
        self._triangles = TriangleMesh(self._scene, mesh.vertices, mesh.faces)
        self._faces = _Faces(mesh.face_instance, mesh.face_material, mesh.face_uv, _shades(mesh, lighting))
        self._atlas = _pack(mesh.materials)

    def render(self, camera: Camera, camera_to_world: Float[np.ndarray, "4 4"], colour: bool = True) -> Image:
        """Render the image of `camera` from a pose with six degrees of freedom.

        Args:
            camera: camera whose size and field of view are used; its mounting is part of the pose.
            camera_to_world: rigid transform from the optical frame (x right, y down, z forward) to the world frame.
            colour: whether `rgb` is needed; a renderer may leave it black otherwise.

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
    """Return the renderer of the scene if it has one, else a ray caster of its mesh."""
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
                f"renderer: got {len(getattr(mesh, name))} rows of mesh.{name}, expected {count}, one for each face"
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


def _check_indices(name: str, indices: Int32[np.ndarray, "..."], count: int, target: str) -> None:
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= count:
        raise UserError(
            f"renderer: got indices {low} to {high} in mesh.{name}, expected 0 to {count - 1}, the {target} of the mesh"
        )


def _check_pose(camera_to_world: Float[np.ndarray, "4 4"]) -> None:
    rotation = camera_to_world[:3, :3]
    if not np.isfinite(camera_to_world).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise UserError(
            f"renderer: got the camera pose {camera_to_world.tolist()}, expected a finite rigid transform"
        )


def _shades(mesh: Mesh, lighting: Lighting) -> Float32[np.ndarray, "m 2 3"]:
    """Return the colour of the front (corners counter-clockwise) and back of each face without texture, 0 to 255."""
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    cosine = normal @ lighting.directions.T
    sides = np.stack([np.maximum(cosine, 0.0), np.maximum(-cosine, 0.0)], axis=1)
    light = np.array(lighting.ambient, np.float32) + sides @ lighting.colours
    colours = np.array([material.colour for material in mesh.materials], np.float32)
    return np.asarray(255 * light * colours[mesh.face_material][:, None], np.float32)


def _pack(materials: tuple[Material, ...]) -> _Atlas:
    """Pack the textures of all materials into one array of texels."""
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
    """Return the origins and directions of the rays in the world frame, row by row.

    The component of each direction along the optical axis is 1, so that the distance of a hit, in lengths of the
    direction, is the depth.
    """
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
    """Shade the image from the hits of the rays."""
    half, white = np.float32(0.5), np.float32(255)
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
                rgb[ray, channel] = min(faces.shade[face, side, channel] + half, white)
            continue
        second, third = hits.second[ray], hits.third[ray]
        first = np.float32(1) - second - third
        u = first * faces.uv[face, 0, 0] + second * faces.uv[face, 1, 0] + third * faces.uv[face, 2, 0]
        v = first * faces.uv[face, 0, 1] + second * faces.uv[face, 1, 1] + third * faces.uv[face, 2, 1]
        texel = _texel(atlas, material, u, v)
        for channel in range(3):
            rgb[ray, channel] = min(faces.shade[face, side, channel] * texel[channel] + half, white)


@compiled
def _texel(
    atlas: _Atlas, material: int, u: np.float32, v: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """Return the bilinear colour, 0 to 1, of a repeating texture; its first row is at the top (v = 1)."""
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
    indices = (upper + left, upper + right, lower + left, lower + right)
    return (
        _mix(atlas.texels, indices, weights, 0),
        _mix(atlas.texels, indices, weights, 1),
        _mix(atlas.texels, indices, weights, 2),
    )


@compiled
def _neighbours(fraction: np.float32, count: int) -> tuple[int, int, np.float32]:
    """Return the two of `count` texels next to the coordinate `fraction` (0 to 1), and the weight of the second."""
    position = fraction * np.float32(count) - np.float32(0.5)
    first = int(np.floor(position))
    second = first + 1
    weight = position - np.float32(first)
    return (first if first >= 0 else count - 1), (second if second < count else 0), weight


@compiled
def _mix(
    texels: UInt8[np.ndarray, "t 3"],
    indices: tuple[int, int, int, int],
    weights: tuple[np.float32, np.float32, np.float32, np.float32],
    channel: int,
) -> np.float32:
    """Return the weighted sum of one channel of four texels."""
    return (
        weights[0] * np.float32(texels[indices[0], channel])
        + weights[1] * np.float32(texels[indices[1], channel])
        + weights[2] * np.float32(texels[indices[2], channel])
        + weights[3] * np.float32(texels[indices[3], channel])
    )
