import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from imagination.recordings.pose_filters import MAX_SPEED, Jumps, Order
from imagination.recordings.tf_tree import Transforms
from imagination.recordings.trajectory import SECOND, Trajectory, interpolate, matrix_of
from imagination.utils.errors import UserError

angles = st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3)


def rigid(place: list[float], turn: Rotation) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), place
    return matrix


@given(one=angles, other=angles, fraction=st.floats(0, 1))
def test_interpolation_agrees_with_scipy(one: list[float], other: list[float], fraction: float) -> None:
    ends = Rotation.from_rotvec([one, other])
    if (ends[0].inv() * ends[1]).magnitude() > np.pi - 1e-3:
        return  # half a turn: two shortest rotations
    got = interpolate(rigid([0, 1, 2], ends[0]), rigid([4, 1, -2], ends[1]), fraction)
    np.testing.assert_allclose(got[:3, :3], Slerp([0, 1], ends)(fraction).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(got[:3, 3], [4 * fraction, 1, 2 - 4 * fraction], atol=1e-9)


def test_half_a_turn_is_a_rotation_all_the_way() -> None:
    for axis in np.eye(3):
        got = interpolate(np.eye(4), rigid([0, 0, 0], Rotation.from_rotvec(np.pi * axis)), 0.5)[:3, :3]
        np.testing.assert_allclose(got @ got.T, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(got), 1)
        np.testing.assert_allclose(got @ axis, axis, atol=1e-9)


@given(
    quaternion=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(
        lambda q: 0.6 < np.linalg.norm(q) < 1.9
    )
)
def test_matrices_agree_with_scipy(quaternion: list[float]) -> None:
    np.testing.assert_allclose(
        matrix_of((1, 2, 3), quaternion), rigid([1, 2, 3], Rotation.from_quat(quaternion)), atol=1e-9
    )


def test_invalid_poses_are_refused() -> None:
    for place, turn in (
        ((0, 0, np.nan), (0, 0, 0, 1)),
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (np.inf, 0, 0, 1)),
    ):
        with pytest.raises(UserError, match="pose: got"):
            matrix_of(place, turn)


def shifted(x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def test_gaps_ends_late_and_repeated_entries() -> None:
    trajectory = Trajectory(max_gap=1.0)
    for second in (0, 1, 3, 2.5, 1):
        trajectory.add(round(second * 1e9), shifted(second))
    assert trajectory.repeated == 1 and len(trajectory) == 4

    def x(second: float) -> float | None:
        found = trajectory.at(round(second * 1e9))
        return None if found is None else float(found[0, 3])

    assert [x(0), x(0.25), x(1), x(2.75), x(3)] == pytest.approx([0, 0.25, 1, 2.75, 3])
    assert [x(-0.1), x(1.5), x(3.1)] == [None, None, None]  # before, in a gap of 1.5 s, after


def test_only_the_recent_past_is_kept() -> None:
    trajectory = Trajectory(max_gap=1.0, keep=5.0)
    for second in range(1000):
        trajectory.add(second * 10**9, shifted(second))
    assert len(trajectory) == 6


def test_an_outlier_is_refused_and_a_clock_reset_is_followed() -> None:
    live = Trajectory(max_gap=1.0, keep=30.0)
    for second in range(10):
        live.add((1000 + second) * 10**9, shifted(second))
    for stray in (2**31 - 1, 0):
        with pytest.raises(UserError, match=rf"pose: got the time {stray}.000 s"):
            live.add(stray * 10**9, shifted(0))
        live.add((1010 + (not stray)) * 10**9, shifted(10))
    assert len(live) == 12 and live.at(1009_500_000_000) is not None
    with pytest.raises(UserError, match="pose: got the time 1000.000 s"):
        live.add(1000 * 10**9, shifted(50))
    live.add(1001 * 10**9, shifted(51))  # the second one confirms the reset
    assert len(live) == 2
    found = live.at(1000_500_000_000)
    assert found is not None and found[0, 3] == pytest.approx(50.5)
    recorded = Trajectory(max_gap=1.0)
    for second in (5000, 0, 10_000):
        recorded.add(second * 10**9, shifted(second))
    assert len(recorded) == 3


def test_a_tree_of_frames() -> None:
    transforms = Transforms(max_gap=1.0)
    turn = rigid([1.0, 0, 0], Rotation.from_euler("z", 90, degrees=True))
    transforms.add("base", "/camera", 0, turn, fixed=True)
    for second in (0, 1):
        transforms.add("odom", "base", second * 10**9, shifted(2.0 * second), fixed=False)
        transforms.add("/map", "odom", second * 10**9, shifted(10.0), fixed=False)
    found = transforms.at("map", "camera", 500_000_000)
    assert found is not None
    np.testing.assert_allclose(found @ [1, 0, 0, 1], [12, 1, 0, 1])
    assert transforms.ancestors("camera") == ["camera", "base", "odom", "map"]
    assert transforms.at("map", "camera", 2 * 10**9) is None
    with pytest.raises(UserError, match="'camera' .*'earth'.*camera in base in odom in map"):
        transforms.at("earth", "camera", 0)
    with pytest.raises(UserError, match="'base' .*'odom' and 'map'"):
        transforms.add("map", "base", 0, np.eye(4), fixed=True)
    with pytest.raises(UserError, match="tf: frame 'map'"):
        transforms.add("camera", "map", 0, np.eye(4), fixed=True)
    transforms.add("base", "depth", 0, shifted(1.0), fixed=True)
    np.testing.assert_allclose(transforms.between("depth", "camera") @ [0, 1, 0, 1], [1, 0, 0, 1], atol=1e-12)
    with pytest.raises(UserError, match="tf: 'depth' and 'map'"):
        transforms.between("depth", "map")
    with pytest.raises(UserError, match="tf: 'depth' and 'lidar'"):
        transforms.between("depth", "lidar")


def test_an_outlier_pose_is_refused_and_a_relocalised_robot_is_accepted() -> None:
    def accepted(places: list[float]) -> list[bool]:
        jumps, found = Jumps(), []
        for number, x in enumerate(places):
            try:
                jumps.check(number * SECOND // 10, shifted(x))
                found.append(True)
            except UserError as error:
                assert str(error).startswith("pose: got") and f"at most {MAX_SPEED} m/s" in str(error)
                found.append(False)
        return found

    assert accepted([0.0, 0.1, 9.0, 0.3, 0.4]) == [True, True, False, True, True]
    assert accepted([0.0, 9.0, 9.1, 9.2]) == [True, False, True, True]
    assert accepted([0.0, 9.0, -9.0, 0.2]) == [True, False, False, True]
    assert accepted([0.0, 0.9, 2.0]) == [True, True, False]  # 0.5 m and 5 m/s over 0.1 s


def test_an_outlier_time_stamp_costs_itself_and_one_more() -> None:
    def in_order(seconds: list[float]) -> list[float]:
        order = Order()
        return [second for second in seconds if not order.fault(round(second * SECOND))]

    assert in_order([0, 1, 1, 2, 1.5, 3]) == [0, 1, 2, 3]
    assert in_order([0, 1, 9000, 2, 3, 4, 5]) == [0, 1, 9000, 3, 4, 5]
    assert in_order([100, 101, 0, 102, 1, 103]) == [100, 101, 102, 103]  # single outliers
    assert in_order([100, 101, 0, 1, 2]) == [100, 101, 1, 2]  # clock reset
    order = Order()
    assert [order.fault(stamp) for stamp in (5, 5, 4)] == [
        "",
        "repeated time stamp",
        "time stamp out of order",
    ]


def test_the_number_of_frames_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imagination.recordings.tf_tree.MAX_FRAMES", 3)
    transforms = Transforms(0.5)
    for number in range(3):
        transforms.add("map", f"track_{number}", 0, np.eye(4), fixed=False)
    with pytest.raises(UserError, match="got frame 'track_3'"):
        transforms.add("map", "track_3", 0, np.eye(4), fixed=False)
    transforms.add("map", "track_0", SECOND, np.eye(4), fixed=False)
