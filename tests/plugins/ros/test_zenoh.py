"""`imagination.serve` and a robot in another process that communicate over Zenoh."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from imagination.deployment.load import load
from imagination.mapping.map_io import load_maps
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.utils.errors import UserError
from tests.conftest import ROOT, Command
from tests.helpers.robot import ROS2, corridor_path, drive
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import CAMERA

pytest.importorskip("zenoh")
sys.path.append(str(ROOT / "plugins" / "ros"))

from imagination_ros.zenoh_transport import ZenohTransport  # noqa: E402


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait(arrived: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not arrived():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.slow
def test_a_robot_in_another_process(tmp_path: Path, unit_file: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    arguments = [
        "server=zenoh",
        f"unit={unit_file}",
        "server.topics.depth=/camera/depth/image_rect_raw",
        "server.topics.depth_info=/camera/depth/camera_info",
        "server.period=0.01",
        f"server.transport.listen=[{endpoint}]",
        "server.transport.connect=[]",
        "server.transport.max_bytes=50000",
    ]
    with open(tmp_path / "log", "w") as log:
        command = [sys.executable, "-m", "imagination.serve", *arguments]
        server = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=log)
        try:
            while "Listening" not in (tmp_path / "log").read_text():
                assert server.poll() is None, (tmp_path / "log").read_text()
                time.sleep(0.1)
            robot = [sys.executable, "-m", "tests.helpers.robot_process", endpoint, str(tmp_path)]
            subprocess.run(robot, cwd=ROOT, env=environment, check=True, timeout=180)
            server.send_signal(signal.SIGINT)
            assert server.wait(60) == 0
        finally:
            server.kill()
    text = (tmp_path / "log").read_text()
    assert "Traceback" not in text
    assert "10 frames mapped" in text
    assert "10 x refused: colour" in text and "10 x refused: tf" in text
    assert "sensor_msgs/msg/Image: got" in text and "got 100000 bytes" in text
    maps = load_maps(tmp_path / "outputs" / "serve" / "latest")
    wanted = SemanticMapper(load(unit_file))
    scene = tiny_room()
    for frame in drive(scene, CAMERA, corridor_path(scene.free_space, 10)):
        wanted.update(frame.rgb, frame.depth, frame.pose)
    np.testing.assert_allclose(maps.probabilities, wanted.maps.probabilities, atol=1e-5)
    grid = ROS2.deserialize_cdr(
        (tmp_path / "imagination_occupancy").read_bytes(), "nav_msgs/msg/OccupancyGrid"
    )
    np.testing.assert_array_equal(
        grid.data.reshape(grid.info.height, -1)[::-1], wanted.maps.occupancy_layer()
    )
    assert (tmp_path / "imagination_chair").is_file() and (tmp_path / "imagination_objects").is_file()


def test_the_map_is_saved_whatever_ends_the_service(
    command: Command, tmp_path: Path, unit_file: Path
) -> None:
    done = command(
        "serve",
        f"unit={unit_file}",
        "server.transport._target_=tests.helpers.failing_transport.FailingTransport",
        "server.topics.depth=/camera/depth/image_rect_raw",
        "server.topics.depth_info=/camera/depth/camera_info",
    )
    assert done.returncode != 0 and "the network is gone" in done.stderr
    assert load_maps(tmp_path / "outputs" / "serve" / "latest").known.any()


@pytest.mark.parametrize(
    ("mistake", "expected"),
    [
        (["start=none.yaml"], "none.yaml: "),
        (["extent=5", "centre=[1]"], "centre: got [1]"),
        (["extent=0"], "got 0"),
    ],
)
def test_mistakes_in_the_config_show_before_it_listens(
    command_in_process: Command, unit_file: Path, mistake: list[str], expected: str
) -> None:
    done = command_in_process("serve", f"unit={unit_file}", *mistake)
    assert done.returncode == 2 and expected in done.stderr
    assert "Traceback" not in done.stderr and "Listening" not in done.stderr


def test_a_service_that_mapped_nothing_reports_an_error(command: Command, unit_file: Path) -> None:
    done = command(
        "serve",
        f"unit={unit_file}",
        "server.transport._target_=tests.helpers.failing_transport.SilentTransport",
    )
    assert done.returncode == 1 and "no frame was mapped" in done.stderr


def test_an_endpoint_that_is_taken_is_one_message(command_in_process: Command, unit_file: Path) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        done = command_in_process(
            "serve", f"unit={unit_file}", f"server.transport.listen=[tcp/127.0.0.1:{port}]"
        )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "zenoh: cannot listen on" in done.stderr


@pytest.mark.parametrize("listen", ["tcp/127.0.0.1:7555", ["nonsense"], [5], [""]])
def test_an_invalid_endpoint_is_one_message(listen: object) -> None:
    transport = ZenohTransport("ros2_humble", listen, [], 1000)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="server.transport.listen"):
        transport.open()


def test_messages_that_are_too_large() -> None:
    """Messages over the limit are refused by size without a copy; much larger ones are dropped by Zenoh."""
    import zenoh

    endpoint = f"tcp/127.0.0.1:{free_port()}"
    transport = ZenohTransport("ros2_humble", [endpoint], [], 100_000)
    transport.open()
    heard: list[object] = []
    transport.subscribe("/words", "std_msgs/msg/String", False, heard.append)
    config = zenoh.Config()
    for key, value in (
        ("mode", "peer"),
        ("listen/endpoints", []),
        ("connect/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
        ("transport/shared_memory/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        speaker = session.declare_publisher("words", congestion_control=zenoh.CongestionControl.BLOCK)
        wait(lambda: speaker.matching_status.matching)
        for size in (200_000, 500_000):
            speaker.put(bytes(size))
        speaker.put(transport.codec.encode(ROS2.types["std_msgs/msg/String"]("words"), "std_msgs/msg/String"))
        wait(lambda: len(heard) > 1)
    transport.close()
    refused, words = heard
    assert "got 200000 bytes" in str(refused)
    assert words.data == "words"  # type: ignore[attr-defined]


def test_a_message_is_not_copied_before_its_size_is_known() -> None:
    class Payload:
        def __len__(self) -> int:
            return 1001

    def declare(key: str, handle: Callable[[object], None]) -> None:
        handle(SimpleNamespace(payload=Payload()))

    transport = ZenohTransport("ros2_humble", [], [], 1000)
    transport._session = SimpleNamespace(declare_subscriber=declare)
    heard: list[object] = []
    transport.subscribe("/words", "std_msgs/msg/String", False, heard.append)
    assert "got 1001 bytes" in str(heard[0])


@pytest.mark.parametrize("max_bytes", [0, 2**31])
def test_an_invalid_largest_size_is_refused(max_bytes: int) -> None:
    with pytest.raises(UserError, match="server.transport.max_bytes: got"):
        ZenohTransport("ros2_humble", [], [], max_bytes)


def test_without_rclpy_the_error_names_the_installation(command_in_process: Command, unit_file: Path) -> None:
    try:
        import rclpy  # noqa: F401
    except ImportError:
        done = command_in_process("serve", "server=rclpy", f"unit={unit_file}")
        assert done.returncode == 2 and "rclpy: is not installed" in done.stderr
