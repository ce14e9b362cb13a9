"""The node and a transport joined: what it subscribes to, what it publishes, and how it ends."""

import logging
import signal
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from imagination.recordings.ros_messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    ODOMETRY,
    TRANSFORMS,
    is_rectified,
)
from imagination.utils.errors import check_range
from imagination_ros.codec import Codec
from imagination_ros.node import MakeMapper, MappingNode

log = logging.getLogger(__name__)


class Transport(Protocol):
    """Carries messages between the node and everybody else.

    Attributes:
        codec: of its messages.
    """

    codec: Codec

    def open(self) -> None:
        """Connect.

        Raises:
            UserError: if what it needs is not installed, or it cannot listen or connect.
        """

    def subscribe(self, topic: str, kind: str, latched: bool, receive: Callable[[Any], None]) -> None:
        """Have `receive` called with each message; with those of the past too if `latched`.

        What it is called with is a message with fields; it may be called from any thread and raises nothing. Messages
        that cannot be decoded are handed on as the UserError that says why.
        """

    def publish(self, topic: str, kind: str, message: Any) -> None:
        """Send a message; those who come later get the last one."""

    def close(self) -> None:
        """Disconnect."""


class RosServer:
    """Serves a robot through a transport; see `MappingNode` for what is not here.

    Args:
        transport: carries the messages.
        topics: names of colour, depth, colour_info, depth_info, and odometry (None: /tf).
        compressed: whether `colour` and `depth` are CompressedImage.
        rectified: whether images are; see `is_rectified`.
        publish: namespace of what is published.

    Raises:
        UserError: on a value out of range.
    """

    def __init__(
        self,
        transport: Transport,
        topics: Mapping[str, str | None],
        compressed: Mapping[str, bool],
        rectified: bool | None,
        publish: str,
        period: float,
        world: str,
        mount: Mapping[str, Any] | None,
        depth_scale: float,
        max_difference: float,
        max_gap: float,
        max_speed: float | None,
        patience: float,
    ) -> None:
        check_range("server.period", period, 0.01, 3600.0, "s")
        check_range("server.patience", patience, 0.0, 60.0, "s")
        check_range("server.max_difference", max_difference, 0.0, 10.0, "s")
        check_range("server.max_gap", max_gap, 0.0, 60.0, "s")
        check_range("server.depth_scale", depth_scale, 1.0, 1e6, "units a metre")
        self.transport, self.topics, self.compressed, self.namespace = (
            transport,
            dict(topics),
            dict(compressed),
            publish,
        )
        self.settings: dict[str, Any] = {
            "world": world,
            "mount": mount,
            "depth_scale": depth_scale,
            "max_difference": max_difference,
            "max_gap": max_gap,
            "max_speed": max_speed,
            "rectified": {kind: is_rectified(str(topics[kind]), rectified) for kind in ("colour", "depth")},
            "patience": patience,
            "period": period,
        }

    def serve(self, make_mapper: MakeMapper) -> None:
        """See `imagination.serve.Server`; ends on Ctrl-C and on SIGTERM."""
        stop = threading.Event()
        before = {
            number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)
        }
        self.transport.open()
        node = MappingNode(make_mapper, self._publish, self.transport.codec, **self.settings)
        try:
            for role, topic, kind in self._subscriptions():

                def receive(message: Any, role: str = role) -> None:
                    node.receive(role, message)

                self.transport.subscribe(topic, kind, role == "tf_static", receive)
            log.info("Listening; Ctrl-C ends and saves the map")
            while not stop.is_set():
                node.step(timeout=0.1)
            node.tell_rest()
        finally:
            self.transport.close()
            for number, handler in before.items():
                signal.signal(number, handler)
            log.info("%s", node.summary())

    def _subscriptions(self) -> list[tuple[str, str, str]]:
        """Role, topic and type of each."""
        kinds = {kind: COMPRESSED if self.compressed[kind] else IMAGE for kind in ("colour", "depth")}
        kinds |= {"colour_info": CAMERA_INFO, "depth_info": CAMERA_INFO}
        found = [(role, str(self.topics[role]), kind) for role, kind in kinds.items()]
        found.append(("tf_static", "/tf_static", TRANSFORMS))
        if self.topics.get("odometry"):
            found.append(("odometry", str(self.topics["odometry"]), ODOMETRY))
        else:
            found.append(("tf", "/tf", TRANSFORMS))
        return found

    def _publish(self, name: str, kind: str, message: Any) -> None:
        self.transport.publish(f"/{self.namespace.strip('/')}/{name}", kind, message)
