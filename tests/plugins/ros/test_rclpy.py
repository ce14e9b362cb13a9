"""Rclpy transport with a stand-in for rclpy's documented interface; not tested with a real ROS 2."""

import os
import sys
import threading
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imagination.utils.errors import UserError
from tests.conftest import ROOT
from tests.helpers.robot import ROS2, Messages

sys.path.append(str(ROOT / "plugins" / "ros"))

from imagination_ros.codec import GRID  # noqa: E402
from imagination_ros.rclpy_transport import RclpyTransport  # noqa: E402


class StandIn:
    """Stand-in for rclpy that records the calls of the transport."""

    def __init__(self) -> None:
        self.subscriptions: dict[str, Any] = {}
        self.published: list[tuple[str, Any]] = []
        self.qualities: dict[str, Any] = {}
        self.environments: list[dict[str, str]] = []
        self.stopped = threading.Event()

    def modules(self) -> dict[str, Any]:
        def publisher(topic: str, quality: Any) -> SimpleNamespace:
            self.qualities[topic] = quality
            return SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

        node = SimpleNamespace(
            create_subscription=lambda kind, topic, handle, quality: self.subscriptions.update(
                {topic: (kind, handle, quality)}
            ),
            create_publisher=lambda kind, topic, quality: publisher(topic, quality),
        )
        policies = SimpleNamespace(TRANSIENT_LOCAL=1, VOLATILE=2, RELIABLE=1, BEST_EFFORT=2)
        made: dict[str, dict[str, Any]] = {
            "rclpy": {
                "init": lambda signal_handler_options: self.environments.append(dict(os.environ)),
                "create_node": lambda name: node,
                "spin": lambda _: self.stopped.wait(10),
                "shutdown": self.stopped.set,
            },
            "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO=0)},
            "rclpy.qos": {
                "QoSProfile": lambda **values: SimpleNamespace(**values),
                "DurabilityPolicy": policies,
                "ReliabilityPolicy": policies,
            },
            "rclpy.serialization": {"deserialize_message": lambda data, kind: kind(data)},
            "nav_msgs.msg": {"OccupancyGrid": lambda data: ROS2.deserialize_cdr(data, GRID)},
            "sensor_msgs.msg": {"Image": SimpleNamespace},
        }
        modules = {}
        for name, values in made.items():
            modules[name] = ModuleType(name)
            vars(modules[name]).update(values)
        return modules


def test_messages_come_and_go(monkeypatch: pytest.MonkeyPatch) -> None:
    ros = StandIn()
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    transport = RclpyTransport("ros2_humble", 1000)
    monkeypatch.setattr(os, "environ", {})
    transport.open()
    heard: list[Any] = []
    transport.subscribe("/camera/color", "sensor_msgs/msg/Image", False, heard.append)
    transport.subscribe("/tf_static", "sensor_msgs/msg/Image", True, heard.append)
    kind, handle, quality = ros.subscriptions["/camera/color"]
    assert kind is SimpleNamespace and (quality.durability, quality.reliability) == (2, 2)
    assert (
        ros.subscriptions["/tf_static"][2].durability,
        ros.subscriptions["/tf_static"][2].reliability,
    ) == (1, 1)
    handle(message := Messages(ROS2).image(5, "camera", "rgb8", np.zeros((4, 4, 3), np.uint8)))
    handle(Messages(ROS2).image(5, "camera", "rgb8", np.zeros((40, 40, 3), np.uint8)))
    assert heard[0] is message and isinstance(heard[1], UserError)
    assert "got 4800 bytes" in str(heard[1])
    from imagination.geometry.grid import Grid

    layer = np.arange(-1, 5, dtype=np.int8).reshape(2, 3)
    grid = transport.codec.occupancy_grid(layer, Grid(0.1, 2, 3, (1.0, 2.0)), "map", 7)
    transport.publish("/imagination/occupancy", GRID, grid)
    ((topic, sent),) = ros.published
    quality = ros.qualities["/imagination/occupancy"]
    assert (quality.durability, quality.reliability, quality.depth) == (1, 1, 1)
    assert topic == "/imagination/occupancy" and sent.data.tolist() == [2, 3, 4, -1, 0, 1]
    transport.close()
    assert ros.stopped.is_set()


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOCALHOST_ONLY": "1"}),
        ({"ROS_LOCALHOST_ONLY": "0"}, {"ROS_LOCALHOST_ONLY": "0"}),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}),
    ],
)
def test_communication_is_restricted_to_this_machine_by_default(
    given: dict[str, str], wanted: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ros = StandIn()
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    transport = RclpyTransport("ros2_humble", 1000)
    monkeypatch.setattr(os, "environ", given.copy())
    transport.open()
    transport.close()
    assert ros.environments == [wanted]
