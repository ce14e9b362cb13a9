import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imagination.geometry.camera import Camera
from imagination.geometry.image_alignment import Alignment, valid_radius
from imagination.geometry.pose import Pose
from imagination.geometry.rgbd import Intrinsics, Placement, RgbdCamera
from imagination.scenes.renderer import Renderer
from imagination.utils.errors import UserError
from tests.helpers.rooms import tiny_room

TARGET = Camera.from_degrees(64, 64, 80.0, 1.2)
POSE = Pose(0.6, -0.9, 2.2)


def level(target: Camera, heading: float) -> np.ndarray:
    return target.to_world(Pose(0.0, 0.0, heading))[:3, :3]


def rendered(camera: Camera, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scene = tiny_room()
    image = Renderer(scene.mesh, scene.lighting).render(camera, matrix)
    return image.rgb, image.depth


@pytest.mark.parametrize(
    ("camera", "turn"),
    [
        (Camera.from_degrees(200, 150, 100.0, 1.2), (0.0, 0.0)),
        (Camera.from_degrees(200, 200, 110.0, 1.2, pitch=15.0), (15.0, 0.0)),
        (Camera.from_degrees(240, 240, 110.0, 1.2, pitch=-8.0, roll=12.0), (-8.0, 12.0)),
    ],
)
def test_an_image_becomes_that_of_the_ideal_camera_at_the_same_place(
    camera: Camera, turn: tuple[float, float]
) -> None:
    """The image rendered with the ideal camera is the independent reference."""
    matrix = camera.to_world(POSE)
    rgb, depth = rendered(camera, matrix)
    place = Placement.of(matrix)
    assert np.allclose(np.rad2deg([place.pitch, place.roll]), turn)
    got_rgb, got = Alignment(RgbdCamera.of(camera), TARGET)(
        rgb, depth, level(TARGET, place.pose.theta).T @ matrix[:3, :3]
    )
    expected_rgb, expected = rendered(TARGET, TARGET.to_world(POSE))
    both = (got > 0) & (expected > 0)
    assert both.mean() > 0.75
    assert (np.abs(got - expected)[both] < 0.02 * expected[both]).mean() > 0.93
    assert (np.abs(got_rgb.astype(int) - expected_rgb).max(axis=2)[both] < 40).mean() > 0.9


def test_depth_of_a_separate_camera_is_registered_to_colour() -> None:
    colour, separate = TARGET, Camera.from_degrees(120, 90, 100.0, 1.2)
    matrix = colour.to_world(POSE)
    offset = np.eye(4)
    offset[:3, :3] = Rotation.from_euler("y", 3, degrees=True).as_matrix()
    offset[:3, 3] = [0.08, 0.01, -0.02]  # right, down, behind
    rgb, expected = rendered(colour, matrix)
    _, depth = rendered(separate, matrix @ offset)
    camera = RgbdCamera(Intrinsics.of(colour), Intrinsics.of(separate), offset)
    got_rgb, got = Alignment(camera, colour)(rgb, depth, np.eye(3))
    assert np.abs(got_rgb.astype(int) - rgb).max() <= 1
    both = (got > 0) & (expected > 0)
    assert both.mean() > 0.8
    assert (np.abs(got - expected)[both] < 0.03 * expected[both]).mean() > 0.92
    without = RgbdCamera(Intrinsics.of(colour), Intrinsics.of(separate))
    _, wrong = Alignment(without, colour)(rgb, depth, np.eye(3))
    both = (wrong > 0) & (expected > 0)
    assert (np.abs(wrong - expected)[both] < 0.03 * expected[both]).mean() < 0.85


@pytest.mark.parametrize("separate", [False, True])
def test_lookups_are_made_once_for_a_camera_that_is_fixed_to_the_robot(
    separate: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rounding of the heading changes the rotation of the camera slightly from frame to frame."""
    tilted = Camera.from_degrees(96, 72, 100.0, 1.2, pitch=10.0)
    offset = np.eye(4)
    offset[0, 3] = 0.05 * separate
    alignment = Alignment(
        RgbdCamera(Intrinsics.of(tilted), Intrinsics.of(tilted) if separate else None, offset), TARGET
    )
    made: list[int] = []
    for module, name in ((cv2, "initUndistortRectifyMap"), (cv2, "undistortPoints")):
        real = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, real=real: (made.append(1), real(*a))[1])
    rgb, depth = np.zeros((72, 96, 3), np.uint8), np.full((72, 96), 2.0, np.float32)
    for heading in np.linspace(-3, 3, 20):
        matrix = tilted.to_world(Pose(0.3, 0.2, heading))
        place = Placement.of(matrix)
        alignment(rgb, depth, level(TARGET, place.pose.theta).T @ matrix[:3, :3])
    assert len(made) == (1 if separate else 2)  # of colour, and of depth


def test_dense_depth_of_a_separate_camera_leaves_no_holes() -> None:
    """A subsample of a fine depth image gives the target the same depth as all pixels."""
    k = Intrinsics(640, 480, 390.0, 390.0, 319.5, 239.5)
    offset = np.eye(4)
    offset[0, 3] = 0.02
    alignment = Alignment(RgbdCamera(Intrinsics.of(TARGET), k, offset), TARGET)
    v = np.arange(480, dtype=np.float32)[:, None]
    depth = np.broadcast_to(2 + v / 480, (480, 640)).astype(np.float32)  # a wall that leans back
    _, got = alignment(np.zeros((64, 64, 3), np.uint8), depth, np.eye(3))
    focal = TARGET.focal_length
    u, v = np.meshgrid(np.arange(64) + 0.5 - 32, np.arange(64) + 0.5 - 32)
    expected = 2 + (v / focal * 390 + 239.5) / 480
    inside = (np.abs(u / focal) < 0.78) & (np.abs(v / focal) < 0.58)
    assert (got[inside] > 0).all()
    assert np.abs(got - expected)[inside].max() < 0.03


def test_images_of_the_target_camera_are_returned_unchanged() -> None:
    rgb, depth = rendered(TARGET, TARGET.to_world(POSE))
    got = Alignment(RgbdCamera.of(TARGET), TARGET)(rgb, depth, np.eye(3))
    assert got[0] is rgb and got[1] is depth


def test_a_negative_focal_length_flips_the_image_axis() -> None:
    rgb, depth = rendered(TARGET, TARGET.to_world(POSE))
    k = Intrinsics.of(TARGET)
    flipped = Intrinsics(k.width, k.height, k.fx, -k.fy, k.cx, k.height - 1 - k.cy)
    got = Alignment(RgbdCamera(flipped), TARGET)(rgb[::-1].copy(), depth[::-1].copy(), np.eye(3))
    assert np.abs(got[0].astype(int) - rgb).max() <= 1
    np.testing.assert_allclose(got[1], depth, rtol=1e-6)


def test_distortion_is_removed() -> None:
    k = Intrinsics(80, 80, 60.0, 60.0, 39.5, 39.5, (-0.2, 0.05, 0.001, -0.002, 0.0))
    depth = np.tile(np.arange(1, 81, dtype=np.float32), (80, 1))  # the value is the source column + 1
    rgb = np.zeros((80, 80, 3), np.uint8)
    _, got = Alignment(RgbdCamera(k), TARGET)(rgb, depth, np.eye(3))
    ideal = Intrinsics.of(TARGET)
    u, v = np.meshgrid(np.arange(64), np.arange(64))
    rays = np.stack([(u - ideal.cx) / ideal.fx, (v - ideal.cy) / ideal.fy, np.ones(u.shape)], axis=-1)
    points, _ = cv2.projectPoints(
        rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), k.matrix, np.array(k.distortion)
    )
    x, y = points.reshape(64, 64, 2).transpose(2, 0, 1)
    inside = (x > 0) & (x < 79) & (y > 0) & (y < 79)
    assert inside.mean() > 0.5
    assert np.abs(got - 1 - x)[inside].max() <= 0.51


def test_rays_beyond_the_valid_radius_stay_black() -> None:
    """Beyond the valid radius the distortion polynomial folds rays back into the image."""
    k = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5, (0.16, -0.27, 0.0, 0.0, 0.0))
    radius = np.linspace(0, 2, 100_001)
    distorted = radius * (1 + 0.16 * radius**2 - 0.27 * radius**4)
    farthest = radius[distorted.argmax()]
    assert valid_radius(np.array(k.distortion)) == pytest.approx(farthest, abs=2e-3)
    assert valid_radius(np.zeros(5)) == valid_radius(np.array([-0.2, 0.05, 0.0, 0.0])) == np.inf
    assert (
        valid_radius(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0])) == np.inf
    )  # numerator and denominator cancel
    assert valid_radius(np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0])) <= 1  # its denominator passes 0
    white, depth = np.full((480, 640, 3), 255, np.uint8), np.full((480, 640), 2.0, np.float32)
    rgb, got = Alignment(RgbdCamera(k), TARGET)(white, depth, np.eye(3))
    ideal = Intrinsics.of(TARGET)
    u, v = np.meshgrid(np.arange(64), np.arange(64))
    x, y = (u - ideal.cx) / ideal.fx, (v - ideal.cy) / ideal.fy
    distance = np.hypot(x, y)
    assert (distance > farthest).any()
    assert not rgb[distance > farthest].any() and not got[distance > farthest].any()
    middle = (np.abs(x) < 0.5) & (np.abs(y) < 0.4)
    assert (rgb[middle] == 255).all() and (got[middle] == 2).all()


@given(
    x=st.floats(-50, 50),
    y=st.floats(-50, 50),
    theta=st.floats(-3.1, 3.1),
    height=st.floats(0.1, 4.0),
    pitch=st.floats(-1.3, 1.3),
    roll=st.floats(-3.1, 3.1),
    floor=st.floats(-5, 5),
)
def test_placement_is_the_inverse_of_the_cameras_transform(
    x: float, y: float, theta: float, height: float, pitch: float, roll: float, floor: float
) -> None:
    camera = Camera(64, 64, 1.5, height, pitch, roll)
    place = Placement.of(camera.to_world(Pose(x, y, theta), floor), floor)
    np.testing.assert_allclose(
        [*place.pose, place.mount_height, place.pitch, place.roll],
        [x, y, theta, height, pitch, roll],
        atol=1e-9,
    )


def test_invalid_cameras_are_refused() -> None:
    mirrored = np.diag([1.0, -1.0, 1.0, 1.0])
    with pytest.raises(UserError, match="camera_to_world: got the rotation"):
        Placement.of(mirrored)
    with pytest.raises(UserError, match="camera_to_world: got .*nan"):
        Placement.of(np.full((4, 4), np.nan))
    with pytest.raises(UserError, match=r"\|intrinsics.fx\|: got 0.0"):
        Intrinsics(64, 48, 0.0, 60.0, 31.5, 23.5)
    with pytest.raises(UserError, match=r"intrinsics.distortion: got \(0.1,\)"):
        Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5, (0.1,))
    rgb, depth = np.zeros((64, 64, 3), np.uint8), np.zeros((32, 64), np.float32)
    with pytest.raises(UserError, match="depth: got 64 x 32 pixels, expected 64 x 64"):
        Alignment(RgbdCamera.of(TARGET), TARGET)(rgb, depth, np.eye(3))
