"""Mapping node without a transport: published maps, and invalid messages that are refused one by one."""

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from imagination.geometry.grid import Grid
from imagination.geometry.pose import Pose
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.mapping.predictor import Observation
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.recordings.trajectory import SECOND
from imagination.utils.errors import UserError
from tests.conftest import ROOT
from tests.helpers.robot import (
    COLOUR,
    DEPTH,
    ROS2,
    TICK,
    Messages,
    RecordedFrame,
    corridor_path,
    drive,
    robot_messages,
)
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import CAMERA, Toy

sys.path.append(str(ROOT / "plugins" / "ros"))

from imagination_ros.codec import GRID, MARKERS, Codec  # noqa: E402
from imagination_ros.node import MappingNode, topics_of  # noqa: E402

ROLES = {
    COLOUR: "colour",
    DEPTH: "depth",
    "/camera/color/camera_info": "colour_info",
    "/camera/depth/camera_info": "depth_info",
    "/tf": "tf",
    "/tf_static": "tf_static",
    "/odom": "odometry",
}
MESSAGES = Messages(ROS2)


@pytest.fixture(scope="module")
def frames() -> list[RecordedFrame]:
    scene = tiny_room()
    return list(drive(scene, CAMERA, corridor_path(scene.free_space, 10)))


class Listener:
    """Receives the published messages, encoded and decoded."""

    def __init__(self) -> None:
        self.codec = Codec("ros2_humble", 10**8)
        self.received: dict[str, list[Any]] = {}

    def publish(self, name: str, kind: str, message: Any) -> None:
        assert kind == (MARKERS if name == "objects" else GRID)
        self.received.setdefault(name, []).append(self.codec.decode(self.codec.encode(message, kind), kind))


def make_mapper(camera: RgbdCamera) -> SemanticMapper:
    return SemanticMapper(Toy("chair", "bed"), camera)


def make_node(listener: Listener, **settings: Any) -> MappingNode:
    return MappingNode(
        make_mapper, listener.publish, listener.codec, **({"world": "map", "period": 0.0} | settings)
    )


def send(node: MappingNode, taken: RecordedFrame, first: bool = True, odometry: bool = False) -> None:
    for topic, _, message in robot_messages(taken, CAMERA, MESSAGES, first, odometry):
        node.receive(ROLES[topic], message)


def test_the_map_is_that_of_the_mapper_and_is_published(frames: list[RecordedFrame]) -> None:
    listener = Listener()
    node = make_node(listener)
    plain = SemanticMapper(Toy("chair", "bed"))
    for number, taken in enumerate(frames):
        send(node, taken, not number)
        assert node.step(1.0)
        plain.update(taken.rgb, taken.depth, taken.pose)
    assert node.mapper is not None and node.counts == {"mapped": 10}
    maps = plain.maps
    np.testing.assert_allclose(node.mapper.maps.probabilities, maps.probabilities, atol=1e-6)
    assert {name: len(messages) for name, messages in listener.received.items()} == dict.fromkeys(
        ("occupancy", "chair", "bed", "objects"), 10
    )
    for name, layer in (("occupancy", maps.occupancy_layer()), ("bed", maps.category_layer("bed"))):
        grid = listener.received[name][-1]
        assert (grid.info.width, grid.info.height) == (maps.grid.columns, maps.grid.rows)
        assert grid.info.resolution == pytest.approx(0.12) and grid.header.frame_id == "map"
        assert (grid.info.origin.position.x, grid.info.origin.position.y) == pytest.approx(maps.grid.origin)
        np.testing.assert_array_equal(grid.data.reshape(layer.shape)[::-1], layer)
    markers = listener.received["objects"][-1].markers
    objects = maps.objects()
    assert len(markers) == 1 + 2 * len(objects) > 1 and markers[0].action == 3
    assert [point.x for point in markers[1].points][:-1] == pytest.approx(objects[0].outline[:, 0].tolist())
    assert markers[2].text == f"{objects[0].category} {objects[0].confidence:.2f}"


def test_odometry_and_a_mount_instead_of_tf(frames: list[RecordedFrame]) -> None:
    mount = {"frame": "base_link", "height": CAMERA.mount_height, "pitch": 0.0}
    node = make_node(Listener(), world="odom", mount=mount)
    for taken in frames:
        send(node, taken, first=False, odometry=True)
        assert node.step(1.0)
    assert node.counts == {"mapped": 10}


def test_the_latest_wins_and_the_others_are_counted(frames: list[RecordedFrame]) -> None:
    node = make_node(Listener())
    for number, taken in enumerate(frames):
        send(node, taken, not number)
    assert node.step(1.0)
    assert not node.step(0.01)
    assert node.counts == {"mapped": 1, "dropped for a later frame": 9}
    send(node, frames[-1], False)
    send(node, frames[3], False)
    assert not node.step(0.01) and not node.step(0.01)
    assert node.counts["time stamp repeated or out of order"] == 1
    assert "1 frames mapped" in node.summary() and "x dropped for a later frame" in node.summary()


def test_an_image_waits_for_its_pose_but_not_for_ever(frames: list[RecordedFrame]) -> None:
    node = make_node(Listener(), patience=0.05)
    late = [message for message in robot_messages(frames[0], CAMERA, MESSAGES, True) if message[0] == "/tf"]
    for topic, _, message in robot_messages(frames[0], CAMERA, MESSAGES, True):
        if topic != "/tf":
            node.receive(ROLES[topic], message)
    assert not node.step(0.0)
    for topic, _, message in late:
        node.receive(ROLES[topic], message)
    assert node.step(0.0)
    for topic, _, message in robot_messages(frames[1], CAMERA, MESSAGES, False):
        if topic != "/tf":
            node.receive(ROLES[topic], message)
    assert not node.step(0.1) and not node.step(0.0)
    assert node.counts["no pose at its time"] == 1


def test_bad_messages_are_refused_one_by_one(frames: list[RecordedFrame]) -> None:
    node, codec = make_node(Listener()), Codec("ros2_humble", 20_000)
    send(node, frames[0])
    assert node.step(1.0)
    wrong = MESSAGES.image(frames[1].stamp, "camera_optical", "rgb8", frames[1].rgb)
    wrong.data = wrong.data[:100]
    node.receive("colour", wrong)
    node.receive("depth", MESSAGES.image(frames[1].stamp, "camera_optical", "32FC1", frames[1].depth))
    for topic, _, message in robot_messages(frames[1], CAMERA, MESSAGES, False)[:2]:
        node.receive(ROLES[topic], message)
    assert not node.step(0.1)
    assert node.counts["refused: frame"] == 1
    node.receive("tf", MESSAGES.transform(frames[2].stamp, "odom", "base_link", np.eye(4)).transforms[0])
    node.receive("colour_info", wrong)
    turn = MESSAGES.transform(frames[2].stamp, "odom", "base_link", np.eye(4))
    turn.transforms[0].transform.rotation.w = float("nan")
    node.receive("tf", turn)
    assert node.counts["refused: tf"] == 2 and node.counts["refused: colour_info"] == 1
    for data, expected in (
        (bytes(30_000), "got 30000 bytes"),
        (b"\x00\x01\x00\x00\xff", "got 5 bytes"),
    ):
        with pytest.raises(UserError, match=expected):
            codec.decode(data, "sensor_msgs/msg/Image")
    node.receive("colour", UserError("too large"))
    send(node, frames[3], False)
    assert node.step(1.0)
    assert node.counts["mapped"] == 2


def test_one_transform_from_the_future_costs_no_frame(frames: list[RecordedFrame]) -> None:
    node = make_node(Listener())
    for number, taken in enumerate(frames[:4]):
        send(node, taken, not number)
        assert node.step(1.0)
        node.receive("tf", MESSAGES.transform((2**31 - 1) * 10**9, "odom", "base_link", np.eye(4)))
    assert node.counts == {"mapped": 4, "refused: tf": 4}


def test_a_clock_that_goes_back_is_followed(frames: list[RecordedFrame]) -> None:
    """After the restart of a bag or the reset of a simulation: the second pose confirms the new time."""
    node = make_node(Listener(), patience=0.0)
    for number, taken in enumerate(frames[:3]):
        send(node, taken, not number)
        assert node.step(1.0)
    mapped = []
    for taken in frames[:5]:
        send(node, taken._replace(stamp=taken.stamp - 60 * 10**9), False)
        mapped.append(node.step(0.0))
    assert mapped == [False, True, True, True, True]
    assert node.counts["jump back of the clock"] == 1 and node.counts["refused: tf"] == 2


def test_an_image_without_a_partner_stops_nothing_when_the_clock_goes_back(
    frames: list[RecordedFrame],
) -> None:
    """The last colour image of a bag, whose depth was lost, before the bag is played again."""
    node = make_node(Listener(), patience=0.0)
    for number, taken in enumerate(frames[:3]):
        send(node, taken, not number)
        assert node.step(1.0)
    for topic, _, message in robot_messages(frames[3], CAMERA, MESSAGES, False):
        if topic != DEPTH:
            node.receive(ROLES[topic], message)
    mapped = 0
    for taken in frames[:8]:
        messages = robot_messages(taken._replace(stamp=taken.stamp - 60 * 10**9), CAMERA, MESSAGES, False)
        for topic, _, message in sorted(messages, key=lambda topic: topic[0] == COLOUR):  # depth comes first
            node.receive(ROLES[topic], message)
        mapped += node.step(0.0)
    assert mapped == 7


def test_a_mount_carries_a_camera_with_frames_of_its_own(frames: list[RecordedFrame]) -> None:
    """As drivers publish them: the optical frame in camera_link, without a transform to the robot."""
    mount = {"frame": "base_link", "height": CAMERA.mount_height, "pitch": 0.0}
    node = make_node(Listener(), mount=mount)
    within = np.array([[0, 0, 1, 0.02], [-1, 0, 0, 0.015], [0, -1, 0, 0.01], [0, 0, 0, 1.0]])
    plain = SemanticMapper(Toy("chair", "bed"))
    for number, taken in enumerate(frames[:4]):
        if not number:
            node.receive(
                "tf_static", MESSAGES.transform(taken.stamp, "camera_link", "camera_optical", within)
            )
        send(node, taken, first=False)
        assert node.step(1.0)
        plain.update(taken.rgb, taken.depth, taken.pose)
    assert node.mapper is not None
    np.testing.assert_allclose(node.mapper.maps.probabilities, plain.maps.probabilities, atol=1e-6)


def test_a_stray_camera_info_ends_nothing(frames: list[RecordedFrame]) -> None:
    """Frames that would close a ring with the mount, before the first pose and after."""
    mount = {"frame": "base_link", "height": CAMERA.mount_height, "pitch": 0.0}
    node = make_node(Listener(), world="odom", mount=mount)
    for taken in frames[:3]:
        for stray in ("odom", "base_link", "elsewhere"):
            node.receive("colour_info", MESSAGES.info(taken.stamp, stray, Intrinsics.of(CAMERA)))
            node.step(0.0)
        send(node, taken, first=False, odometry=True)
        assert node.step(1.0)
    assert node.counts == {"mapped": 3}


def test_invalid_times_are_refused(frames: list[RecordedFrame]) -> None:
    node = make_node(Listener())
    send(node, frames[0])
    for topic, _, message in robot_messages(
        frames[1]._replace(stamp=(2**31 - 1) * 10**9), CAMERA, MESSAGES, False
    ):
        for entry in getattr(message, "transforms", [message]):
            entry.header.stamp.nanosec = 4 * 10**9
        node.receive(ROLES[topic], message)
    assert node.step(1.0)
    assert node.counts == {"mapped": 1, "refused: tf": 2, "refused: colour": 1, "refused: depth": 1}


def test_any_error_of_one_frame_does_not_affect_the_others(frames: list[RecordedFrame]) -> None:
    class Unreliable(Toy):
        calls = 0

        def __call__(self, observation: Observation) -> np.ndarray:
            self.calls += 1
            if self.calls in (2, 3):
                raise (RuntimeError("INVALID_ARGUMENT"), MemoryError())[self.calls - 2]
            return super().__call__(observation)

    received: list[str] = []

    def publish(name: str, kind: str, message: Any) -> None:
        received.append(name)
        if len(received) == 1:
            raise OSError("the session is closed")

    unreliable = Unreliable()
    node = MappingNode(
        lambda camera: SemanticMapper(unreliable, camera),
        publish,
        Codec("ros2_humble", 10**8),
        "map",
        period=0.0,
    )
    for number, taken in enumerate(frames[:4]):
        send(node, taken, not number)
        assert node.step(1.0) == (number in (0, 3))
    assert node.counts == {"mapped": 2, "refused: frame": 2, "refused: publication": 1}
    assert node.mapper is not None and node.mapper.frames == 2
    assert received == ["occupancy", "occupancy", "chair", "objects"]


def test_images_that_cannot_be_mapped_are_counted_by_the_reason(frames: list[RecordedFrame]) -> None:
    def summary(change: Callable[[list[Any]], list[Any]], **settings: Any) -> str:
        node = make_node(Listener(), patience=0.0, **settings)
        for number, taken in enumerate(frames[:3]):
            for topic, _, message in change(robot_messages(taken, CAMERA, MESSAGES, not number)):
                node.receive(ROLES[topic], message)
            assert not node.step(0.0)
        return node.summary()

    def without(name: str) -> Callable[[list[Any]], list[Any]]:
        return lambda topics: [each for each in topics if each[0] != name]

    def apart(topics: list[Any]) -> list[Any]:
        topics[-1][2].header.stamp.nanosec += 30_000_000
        return topics

    assert "6 x image without a partner within 0.02 s" in summary(apart)
    assert "3 x no camera_info of depth" in summary(without("/camera/depth/camera_info"))
    assert "3 x no transforms from 'camera_optical' to 'map'" in summary(without("/tf"))
    assert "3 x no transforms from 'camera_optical' to 'earth'" in summary(list, world="earth")


def test_topics_are_names_that_ros_allows() -> None:
    names = topics_of(["chair", "night-stand", "night_stand", "3d--printer", "a-"])
    assert names == ["chair", "night_stand", "night_stand2", "category_3d_printer", "a_"]


def test_random_bytes_are_refused() -> None:
    """Every error of the decoder becomes a UserError."""
    codec, rng = Codec("ros2_humble", 10**6), np.random.default_rng(0)
    good = bytearray(
        codec.encode(
            MESSAGES.image(0, "camera", "rgb8", np.zeros((4, 4, 3), np.uint8)), "sensor_msgs/msg/Image"
        )
    )
    refused = 0
    for _ in range(300):
        bad = bytearray(good)
        for place in rng.integers(4, len(good), 6):
            bad[place] = rng.integers(256)
        try:
            codec.decode(bytes(bad[: rng.integers(5, len(bad) + 1)]), "sensor_msgs/msg/Image")
        except UserError:
            refused += 1
    assert refused > 100


def test_other_distributions(frames: list[RecordedFrame]) -> None:
    for name in ("ros2_foxy", "ros2_jazzy"):
        codec = Codec(name, 10**6)
        objects = SemanticMapper(Toy(), threshold=0.3)
        objects.update(frames[0].rgb, frames[0].depth, frames[0].pose)
        found = objects.maps.objects()
        assert sum(obj.area for obj in found) > sum(
            obj.area for obj in replace(objects.maps, thresholds=(0.5,)).objects()
        )
        markers = codec.markers(found, {"chair": (255, 0, 0)}, "map", 5 * 10**9)
        again = codec.decode(codec.encode(markers, MARKERS), MARKERS)
        assert len(again.markers) == 1 + 2 * len(found) and again.markers[1].header.stamp.sec == 5
    with pytest.raises(UserError, match="transport.distribution: got 'ros3'"):
        Codec("ros3", 10)


def late(frames: list[RecordedFrame], rate: int, seconds: float) -> list[tuple[int, str, Any]]:
    """Messages of a standing robot in the first two seconds, with poses that are delayed by some seconds."""
    sent: list[tuple[int, str, Any]] = []
    for number in range(2 * rate):
        taken = frames[0]._replace(stamp=frames[0].stamp + number * SECOND // rate)
        for topic, _, message in robot_messages(taken, CAMERA, MESSAGES, not number):
            wait = round(seconds * SECOND) if topic == "/tf" else 0
            sent.append((taken.stamp + wait, ROLES[topic], message))
    return sorted(sent, key=lambda each: each[0])


@pytest.mark.parametrize("rate", [30, 60])
def test_poses_that_are_always_late_map_all_the_same(
    frames: list[RecordedFrame], rate: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("imagination_ros.node.time.monotonic", lambda: now[0])
    node, mapped = make_node(Listener(), period=100.0), 0
    for arrives, role, message in late(frames, rate, 0.4):
        now[0] = (arrives - frames[0].stamp) / SECOND
        node.receive(role, message)
        mapped += role == "tf" and node.step(0.0)
    assert mapped == node.counts["mapped"] >= 4  # at least one whenever the oldest has its pose


def test_an_invalid_transform_does_not_affect_others(frames: list[RecordedFrame]) -> None:
    """robot_state_publisher sends many at once, e.g. of a joint with NaN or of a grasped object."""
    node = make_node(Listener())
    for number, taken in enumerate(frames[:3]):
        for topic, _, message in robot_messages(taken, CAMERA, MESSAGES, not number):
            if topic == "/tf":
                broken = MESSAGES.transform(taken.stamp, "base_link", "wheel", np.eye(4)).transforms[0]
                broken.transform.rotation.w = float("nan")
                parent = ("shelf", "gripper", "gripper")[number]
                taken_up = MESSAGES.transform(taken.stamp, parent, "cup", np.eye(4)).transforms[0]
                message.transforms = [broken, taken_up, *message.transforms]
            node.receive(ROLES[topic], message)
        assert node.step(1.0)
    assert node.counts == {"mapped": 3, "refused: tf": 6 + 4}


def test_a_stray_pose_is_not_mapped(frames: list[RecordedFrame]) -> None:
    node = make_node(Listener())
    drive = [frames[0]._replace(stamp=frames[0].stamp + number * TICK) for number in range(4)]
    drive[2] = drive[2]._replace(pose=Pose(40.0, 0.0, 0.0))
    assert [send(node, taken, not n) or node.step(1.0) for n, taken in enumerate(drive)] == [
        True,
        True,
        False,
        True,
    ]
    assert node.counts == {"mapped": 3, "refused: jump of the pose": 1}


def test_the_end_of_a_drive_is_published_too(
    frames: list[RecordedFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("imagination_ros.node.time.monotonic", lambda: now[0])
    listener = Listener()
    node = make_node(listener, period=0.2)
    for number, taken in enumerate(frames[:2]):
        send(node, taken, not number)
        assert node.step(1.0)
    assert len(listener.received["occupancy"]) == 1  # the second came too soon
    now[0] = 0.2
    assert not node.step(0.0) and len(listener.received["occupancy"]) == 2
    now[0] = 0.4
    assert not node.step(0.0) and len(listener.received["occupancy"]) == 2  # nothing new


def test_cells_outside_a_map_of_fixed_size_are_counted(frames: list[RecordedFrame]) -> None:
    def make_small(camera: RgbdCamera) -> SemanticMapper:
        return SemanticMapper(Toy("chair", "bed"), camera, grid=Grid.centred(1.2, 0.12))

    node = MappingNode(make_small, Listener().publish, Listener().codec, "map")
    send(node, frames[0])
    assert node.step(1.0)
    assert re.search(r"\d+ cells outside the map of fixed size", node.summary())
