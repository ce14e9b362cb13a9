"""Transport over rclpy, where ROS 2 is installed and sourced."""

import importlib
import logging
import os
import threading
from collections.abc import Callable
from typing import Any

from imagination.utils.errors import UserError
from imagination_ros.codec import Codec

log = logging.getLogger(__name__)

LOOPBACK = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOCALHOST_ONLY": "1"}
"""Environment variables that restrict ROS 2 to this machine: since Iron, and before."""


class RclpyTransport:
    """Transport over an rclpy node; see `imagination_ros.server.Transport`.

    Incoming messages are those of rclpy, whose fields have the names that the mapping node reads. Outgoing messages are
    encoded by the codec and decoded by rclpy. Communication is restricted to this machine unless one of the variables
    of `LOOPBACK` is set.

    Args:
        distribution: installed ROS 2 distribution.
        max_bytes: largest size of a message, bytes.

    Raises:
        UserError: if rclpy or rosbags is not installed.
    """

    def __init__(self, distribution: str, max_bytes: int) -> None:
        try:
            self._rclpy: Any = importlib.import_module("rclpy")
        except ImportError as error:
            raise UserError(
                "rclpy: is not installed; install ROS 2 and source its setup.bash, or use server=zenoh"
            ) from error
        self.codec = Codec(distribution, max_bytes)
        self._publishers: dict[str, Any] = {}

    def open(self) -> None:
        if not os.environ.keys() & LOOPBACK:
            os.environ |= LOOPBACK
            log.info("ROS 2 is restricted to this machine; for other machines: export ROS_LOCALHOST_ONLY=0")
        # the server handles Ctrl-C to save the map first
        options = importlib.import_module("rclpy.signals").SignalHandlerOptions
        self._rclpy.init(signal_handler_options=options.NO)
        self._node = self._rclpy.create_node("imagination")
        self._spinning = threading.Thread(target=self._rclpy.spin, args=(self._node,), daemon=True)
        self._spinning.start()

    def subscribe(self, topic: str, kind: str, latched: bool, receive: Callable[[Any], None]) -> None:
        def handle(message: Any) -> None:
            size = len(getattr(message, "data", ()))
            if size > self.codec.max_bytes:
                message = UserError(f"{kind}: got {size} bytes, expected at most {self.codec.max_bytes}")
            receive(message)

        quality = self._quality(latched, reliable=latched, depth=100 if latched else 5)
        self._node.create_subscription(_type(kind), topic, handle, quality)

    def publish(self, topic: str, kind: str, message: Any) -> None:
        if topic not in self._publishers:
            quality = self._quality(latched=True, reliable=True, depth=1)
            self._publishers[topic] = self._node.create_publisher(_type(kind), topic, quality)
        decode = importlib.import_module("rclpy.serialization").deserialize_message
        self._publishers[topic].publish(decode(self.codec.encode(message, kind), _type(kind)))

    def close(self) -> None:
        self._rclpy.shutdown()
        self._spinning.join(timeout=5)

    def _quality(self, latched: bool, reliable: bool, depth: int) -> Any:
        """Return the quality of service: latched (transient local) or volatile, reliable or best effort."""
        qos = importlib.import_module("rclpy.qos")
        return qos.QoSProfile(
            depth=depth,
            durability=qos.DurabilityPolicy.TRANSIENT_LOCAL if latched else qos.DurabilityPolicy.VOLATILE,
            reliability=qos.ReliabilityPolicy.RELIABLE if reliable else qos.ReliabilityPolicy.BEST_EFFORT,
        )


def _type(kind: str) -> Any:
    """Return the class of a message type, e.g. nav_msgs/msg/OccupancyGrid."""
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)
