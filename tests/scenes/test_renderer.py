"""The renderer against analytic rays and planes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose
from imagination.scenes.renderer import Image, Renderer
from imagination.scenes.scene import Lighting, Material, Mesh
from imagination.scenes.sensor import IdealSensor
from imagination.utils.errors import UserError
from tests.helpers.rooms import BED, CHAIR, TABLE, MeshBuilder, tiny_room

CAMERA = Camera(32, 24, 1.3, 1.25)
DARK = Lighting((1.0, 1.0, 1.0))


def quad(corners: list[list[float]], uv: list[list[float]], material: Material) -> Mesh:
    """Return two triangles with the given corners and texture coordinates."""
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    zeros = np.zeros(2, np.int32)
    return Mesh(
        np.array(corners, np.float32), faces, zeros, zeros, np.array(uv, np.float32)[faces], (material,)
    )  # fmt: skip


def facing(material: Material, uv: list[list[float]], depth: float = 4.0, half: float = 4.0) -> Mesh:
    """Return a square across the optical axis of a camera at the origin; the first corner is lower left."""
    corners = [[-half, half, depth], [half, half, depth], [half, -half, depth], [-half, -half, depth]]
    return quad(corners, uv, material)


UNIT = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]


def rays(camera: Camera, camera_to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return origin and directions with unit component along the optical axis, independently of the renderer."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    tangent = np.tan(camera.field_of_view / 2) / (camera.width / 2)
    local = np.stack(
        [(u - camera.width / 2) * tangent, (v - camera.height / 2) * tangent, np.ones_like(u)], -1
    )
    return camera_to_world[:3, 3], np.einsum("ij,hwj->hwi", camera_to_world[:3, :3], local)


def brute_force(
    mesh: Mesh, camera: Camera, camera_to_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth, instance and the margin to the nearest other instance, by solving for every triangle."""
    origin, directions = rays(camera, camera_to_world)
    depths = []
    for a, b, c in mesh.vertices[mesh.faces].astype(float):
        # origin + t d = a + s (b - a) + r (c - a)
        matrix = np.stack(np.broadcast_arrays(b - a, c - a, -directions), axis=-1)
        solvable = np.abs(np.linalg.det(matrix)) > 1e-12
        matrix[~solvable] = np.eye(3)
        s, r, t = np.moveaxis(
            np.linalg.solve(matrix, np.broadcast_to((origin - a)[:, None], (*directions.shape, 1)))[..., 0],
            -1,
            0,
        )
        depths.append(np.where(solvable & (s >= 0) & (r >= 0) & (s + r <= 1) & (t > 0), t, np.inf))
    stack = np.array(depths)
    nearest = stack.min(axis=0)
    instance = np.where(np.isfinite(nearest), mesh.face_instance[stack.argmin(axis=0)], -1)
    others = np.where(mesh.face_instance[:, None, None] == instance, np.inf, stack).min(axis=0)
    return np.where(np.isfinite(nearest), nearest, 0.0), instance, others - nearest


@settings(max_examples=15, deadline=None)
@given(st.floats(-1.5, 1.5), st.floats(-1.2, 1.2), st.floats(0.3, 2.3), st.integers(0, 2**31))
def test_room_from_any_pose_matches_brute_force(x: float, y: float, z: float, seed: int) -> None:
    scene = tiny_room()
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    pose[:3, 3] = x, y, z
    camera = Camera(16, 12, 1.3, 1.25)
    image = Renderer(scene.mesh, scene.lighting).render(camera, pose)
    depth, instance, margin = brute_force(scene.mesh, camera, pose)
    sure = margin > 1e-3  # a ray along an edge may go either way
    # a ray through the edge that two triangles share may slip between them in floating point
    wrong = sure & (
        (np.abs(image.depth - depth) > 1e-3 * np.maximum(depth, 1)) | (image.instance != instance)
    )
    assert wrong.sum() <= 1


def test_depth_is_along_the_optical_axis_not_along_the_ray() -> None:
    image = Renderer(facing(Material((1.0, 1.0, 1.0)), UNIT, depth=2.5), DARK).render(CAMERA, np.eye(4))
    np.testing.assert_allclose(image.depth, 2.5, rtol=1e-6)


def test_without_colour_the_image_is_not_shaded() -> None:
    renderer = Renderer(facing(Material((1.0, 1.0, 1.0)), UNIT), Lighting((1.0, 1.0, 1.0)))
    assert renderer.render(CAMERA, np.eye(4)).rgb.all()
    assert not renderer.render(CAMERA, np.eye(4), colour=False).rgb.any()


def test_camera_stands_upright_and_is_not_mirrored() -> None:
    scene = tiny_room()
    camera = Camera(64, 64, np.pi / 2, 1.25)
    renderer = Renderer(scene.mesh, scene.lighting)
    image = renderer.render(camera, camera.to_world(Pose(0.0, -1.0, np.pi / 2)))
    # the floor in the last row, 31.5 pixels below the optical axis, lies at depth height * focal length / 31.5
    assert image.depth[63, 32] == pytest.approx(1.25 * 32 / 31.5, rel=1e-5)
    assert image.depth[0, 32] == pytest.approx(1.35 * 32 / 31.5, rel=1e-5)  # ceiling at 2.6 m
    for instance, left in [(CHAIR, True), (TABLE, True), (BED, False)]:
        columns = np.nonzero(image.instance == instance)[1]
        assert len(columns) and ((columns < 32) == left).all()


@pytest.mark.parametrize(("edge", "hit"), [(0.49, True), (0.51, False)])
def test_pixel_samples_its_centre(edge: float, hit: bool) -> None:
    camera = Camera(8, 8, np.pi / 2, 1.25)  # focal length 4: at depth 4 a pixel is 1 m wide
    white = Material((1.0, 1.0, 1.0))
    right = quad([[edge, -4, 4], [4, -4, 4], [4, 4, 4], [edge, 4, 4]], UNIT, white)
    down = quad([[-4, edge, 4], [4, edge, 4], [4, 4, 4], [-4, 4, 4]], UNIT, white)
    columns = Renderer(right, DARK).render(camera, np.eye(4)).depth > 0
    rows = Renderer(down, DARK).render(camera, np.eye(4)).depth > 0
    np.testing.assert_array_equal(columns, np.tile([False] * 4 + [hit] + [True] * 3, (8, 1)))
    np.testing.assert_array_equal(rows, columns.T)


def test_texture_stands_upright() -> None:
    red, green, blue, white = [255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]
    texture = np.array([[red, green], [blue, white]], np.uint8)  # first row at the top
    camera = Camera(8, 8, np.pi / 2, 1.25)
    rgb = Renderer(facing(Material((1.0, 1.0, 1.0), texture), UNIT), DARK).render(camera, np.eye(4)).rgb
    quarters = [[rgb[2, 2], rgb[2, 5]], [rgb[5, 2], rgb[5, 5]]]
    assert (
        np.argmax(quarters[0][0]) == 0 and np.argmax(quarters[0][1]) == 1 and np.argmax(quarters[1][0]) == 2
    )
    assert np.min(quarters[1][1]) > 100


def test_texture_repeats_and_is_interpolated() -> None:
    texture = np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    colour = np.array([0.9, 0.5, 0.7])
    low, high = np.array([-1.3, -0.6]), np.array([2.4, 1.7])
    uv = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
    camera = Camera(40, 40, np.pi / 2, 1.25)
    image = Renderer(facing(Material(tuple(colour), texture), uv), DARK).render(camera, np.eye(4))
    fraction = (np.arange(40) + 0.5) / 40
    u, v = low[0] + fraction * (high[0] - low[0]), high[1] - fraction * (high[1] - low[1])
    places = np.meshgrid((1 - v) * 5 - 0.5, u * 7 - 0.5, indexing="ij")
    expected = np.stack(
        [map_coordinates(texture[..., k].astype(float), places, order=1, mode="grid-wrap") for k in range(3)],
        -1,
    )
    assert np.abs(image.rgb - expected * colour).max() <= 1


def test_each_material_has_its_own_texture() -> None:
    """Three squares side by side: textured, plain, textured."""
    squares = [facing(Material((1.0, 1.0, 1.0)), UNIT, half=1.0) for _ in range(3)]
    vertices = np.concatenate(
        [mesh.vertices + np.float32([2 * k - 2, 0, 0]) for k, mesh in enumerate(squares)]
    )
    faces = np.concatenate([mesh.faces + 4 * k for k, mesh in enumerate(squares)]).astype(np.int32)
    owner = np.repeat(np.arange(3, dtype=np.int32), 2)
    uv = np.concatenate([mesh.face_uv for mesh in squares])
    textures = [np.full((3, 2, 3), 40, np.uint8), None, np.full((4, 5, 3), 200, np.uint8)]
    materials = tuple(Material((1.0, 1.0, 1.0) if t is not None else (0.5, 0.5, 0.5), t) for t in textures)
    image = Renderer(Mesh(vertices, faces, owner + 7, owner, uv, materials), DARK).render(
        Camera(8, 8, np.pi / 2, 1.25), np.eye(4)
    )
    np.testing.assert_array_equal(image.rgb[4, [1, 3, 4, 6], 0], [40, 128, 128, 200])
    np.testing.assert_array_equal(image.instance[4], [-1, 7, 7, 8, 8, 9, 9, -1])
    np.testing.assert_array_equal(image.rgb[4, 0], [0, 0, 0])
    assert image.depth[4, 0] == 0


def test_light_falls_on_either_side_by_the_cosine() -> None:
    """The front of the square faces the camera (-z), with one light in front and a fainter one behind."""
    material = Material((1.0, 0.5, 0.25))
    slanted = np.array([[0.0, np.sqrt(0.75), -0.5], [0.0, 0.0, 1.0]], np.float32)
    lighting = Lighting((0.1, 0.1, 0.2), slanted, np.array([[0.8, 0.4, 0.4], [0.5, 0.5, 0.5]], np.float32))
    renderer = Renderer(facing(material, UNIT), lighting)
    front = renderer.render(CAMERA, np.eye(4)).rgb[12, 16]
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind[2, 3] = 8.0
    back = renderer.render(CAMERA, behind).rgb[12, 16]
    expected = np.array([0.1 + 0.4, 0.1 + 0.2, 0.2 + 0.2]), np.array([0.6, 0.6, 0.7])
    np.testing.assert_allclose(front, 255 * expected[0] * material.colour, atol=0.51)
    np.testing.assert_allclose(back, 255 * expected[1] * material.colour, atol=0.51)


def test_bright_light_saturates() -> None:
    bright = Renderer(facing(Material((1.0, 1.0, 1.0)), UNIT), Lighting((3.0, 1.0, 0.5)))
    np.testing.assert_array_equal(bright.render(CAMERA, np.eye(4)).rgb[0, 0], [255, 255, 128])


def test_rendering_is_deterministic() -> None:
    scene = tiny_room()
    renderer = Renderer(scene.mesh, scene.lighting)
    pose = CAMERA.to_world(Pose(0.2, 0.1, 1.0))
    first = renderer.render(CAMERA, pose)
    renderer.render(Camera(9, 17, 0.7, 1.0), CAMERA.to_world(Pose(0.0, 0.0, 0.0)))
    for one, other in zip(first, renderer.render(CAMERA, pose), strict=True):
        np.testing.assert_array_equal(one, other)
    assert all(
        one is other for one, other in zip(first, IdealSensor()(first, np.random.default_rng(0)), strict=True)
    )
    assert isinstance(first, Image) and first.depth.dtype == np.float32


def test_face_without_area_is_harmless() -> None:
    mesh = quad([[0, 0, 4], [0, 0, 4], [0, 0, 4], [1, 0, 4]], UNIT, Material((1.0, 1.0, 1.0)))
    assert np.isfinite(Renderer(mesh, DARK).render(CAMERA, np.eye(4)).depth).all()


def broken(**changes: object) -> Mesh:
    builder = MeshBuilder()
    builder.box((0, 0, 0), (1, 1, 1), 1)
    mesh = builder.build()
    return Mesh(**{**mesh.__dict__, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (
            broken(
                faces=np.zeros((0, 3), np.int32),
                face_instance=np.zeros(0, np.int32),
                face_material=np.zeros(0, np.int32),
                face_uv=np.zeros((0, 3, 2), np.float32),
            ),
            "without faces",
        ),
        (broken(faces=np.full((12, 3), 24, np.int32)), "24 to 24 in mesh.faces, expected 0 to 23"),
        (broken(faces=np.full((12, 3), -1, np.int32)), "-1 to -1 in mesh.faces"),
        (broken(face_material=np.full(12, 5, np.int32)), "mesh.face_material, expected 0 to 4"),
        (broken(face_instance=np.full(12, -2, np.int32)), "instance id -2"),
        (broken(vertices=np.full((24, 3), np.nan, np.float32)), "NaN or infinity in mesh.vertices"),
    ],
)  # fmt: skip
def test_refuses_broken_meshes(mesh: Mesh, message: str) -> None:
    with pytest.raises(UserError, match=message):
        Renderer(mesh, DARK)


@pytest.mark.parametrize("value", [np.nan, np.inf, 2.0])
def test_refuses_poses_that_are_not_rigid(value: float) -> None:
    pose = np.eye(4)
    pose[0, 0] = value
    with pytest.raises(UserError, match="camera pose"):
        Renderer(broken(), DARK).render(CAMERA, pose)
