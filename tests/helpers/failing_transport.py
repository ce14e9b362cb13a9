"""Transports that end the service: after the map of one frame is published, or before any message."""

import signal
from collections.abc import Callable
from typing import Any

import numpy as np
from imagination_ros.codec import Codec

from imagination.geometry.pose import Pose
from tests.helpers.robot import BEGIN, ROS2, Messages, RecordedFrame, robot_messages
from tests.helpers.toy_units import CAMERA


class FailingTransport:
    """Delivers one frame, interrupts the service when its map is published, and fails when it is closed."""

    def __init__(self, **_: Any) -> None:
        self.codec = Codec("ros2_humble", 10**8)

    def open(self) -> None:
        rgb, depth = np.full((48, 48, 3), 90, np.uint8), np.full((48, 48), 2.0, np.float32)
        taken = RecordedFrame(BEGIN, Pose(0.0, 0.0, 0.0), rgb, depth)
        self.topics = robot_messages(taken, CAMERA, Messages(ROS2), True)

    def subscribe(self, topic: str, kind: str, latched: bool, receive: Callable[[Any], None]) -> None:
        for name, _, message in self.topics:
            if name == topic:
                receive(message)

    def publish(self, topic: str, kind: str, message: Any) -> None:
        signal.raise_signal(signal.SIGINT)

    def close(self) -> None:
        raise RuntimeError("the network is gone")


class SilentTransport(FailingTransport):
    """Interrupts the service before any message."""

    def subscribe(self, topic: str, kind: str, latched: bool, receive: Callable[[Any], None]) -> None:
        signal.raise_signal(signal.SIGINT)

    def close(self) -> None:
        pass
